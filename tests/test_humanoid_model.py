"""The humanoid's model file: masses, joints, motors and posture."""

import mujoco
import numpy as np
import pytest
from humanoid_facts import GEARS, JOINTS, MASSES, NAMES

from fleetjax.physics.base import make_physics


@pytest.fixture(scope="module")
def physics():
    return make_physics("humanoid.xml", substeps=3, backend="native")


def test_masses(physics):
    model = physics.model
    names = [model.body(i).name for i in range(1, model.nbody)]
    assert len(names) == 16
    for name in names:
        kind = name.removeprefix("right_").removeprefix("left_")
        np.testing.assert_allclose(model.body(name).mass, MASSES[kind], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(model.body_mass.sum(), 40.8440, atol=1e-4)


def test_joints(physics):
    model = physics.model
    assert [model.joint(i).name for i in range(1, model.njnt)] == NAMES
    for name, (axis, limits, damping, stiffness, armature, _, _) in JOINTS.items():
        joint = model.joint(name)
        np.testing.assert_allclose(joint.axis, np.array(axis) / np.linalg.norm(axis), atol=1e-12, err_msg=name)
        np.testing.assert_allclose(joint.range, np.radians(limits), rtol=1e-12, err_msg=name)
        found = [joint.damping[0], joint.stiffness[0], joint.armature[0]]
        np.testing.assert_allclose(found, [damping, stiffness, armature], err_msg=name)
        assert model.jnt_limited[joint.id], name


def test_motors(physics):
    model = physics.model
    assert [model.joint(j).name for j in model.actuator_trnid[:, 0]] == NAMES
    np.testing.assert_allclose(model.actuator_gear[:, 0], GEARS)
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-1, 1]] * 21)
    assert model.actuator_ctrllimited.all()


def test_posture(physics):
    """At zero angles the soles are 1.2855 m below the torso's origin, and the centre of mass is where it was computed to be."""
    model = physics.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    soles = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_sole")]
    assert len(soles) == 4
    ends = [
        data.geom_xpos[i] + end * model.geom_size[i, 1] * data.geom_xmat[i].reshape(3, 3)[:, 2]
        for i in soles
        for end in (-1, 1)
    ]
    np.testing.assert_allclose(min(e[2] for e in ends) - 0.027 - 1.34, -1.2855, atol=2e-4)
    np.testing.assert_allclose(data.subtree_com[1] - data.body("torso").xpos, [0.0175, 0, -0.4327], atol=1e-4)
