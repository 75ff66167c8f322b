"""The humanoid in numbers, kept apart from the model file that the tests hold against them."""

import numpy as np

# Each joint in action order: axis in its body, range (deg), damping, stiffness, armature, largest torque (N m), and the
# scaled angle that is observed at 0 rad.
JOINTS = {
    "abdomen_z": ((0, 0, 1), (-45, 45), 5, 20, 0.02, 67.5, 0),
    "abdomen_y": ((0, 1, 0), (-75, 30), 5, 20, 0.01, 67.5, 0.4286),
    "abdomen_x": ((1, 0, 0), (-35, 35), 5, 10, 0.01, 67.5, 0),
    "right_hip_x": ((1, 0, 0), (-45, 15), 5, 10, 0.01, 45, 0.5),
    "right_hip_z": ((0, 0, 1), (-60, 35), 5, 10, 0.01, 45, 0.2632),
    "right_hip_y": ((0, 1, 0), (-120, 45), 5, 20, 0.01, 135, 0.4545),
    "right_knee": ((0, -1, 0), (-160, 2), 0.1, 5, 0.007, 90, 0.9753),
    "right_ankle_y": ((0, 1, 0), (-50, 50), 1, 2, 0.006, 22.5, 0),
    "right_ankle_x": ((1, 0, 0.5), (-50, 50), 1, 2, 0.006, 22.5, 0),
    "left_hip_x": ((-1, 0, 0), (-45, 15), 5, 10, 0.01, 45, 0.5),
    "left_hip_z": ((0, 0, -1), (-60, 35), 5, 10, 0.01, 45, 0.2632),
    "left_hip_y": ((0, 1, 0), (-120, 45), 5, 20, 0.01, 135, 0.4545),
    "left_knee": ((0, -1, 0), (-160, 2), 0.1, 5, 0.007, 90, 0.9753),
    "left_ankle_y": ((0, 1, 0), (-50, 50), 1, 2, 0.006, 22.5, 0),
    "left_ankle_x": ((1, 0, 0.5), (-50, 50), 1, 2, 0.006, 22.5, 0),
    "right_shoulder1": ((2, 1, 1), (-90, 70), 5, 10, 0.01, 67.5, 0.125),
    "right_shoulder2": ((0, -1, 1), (-90, 70), 5, 10, 0.01, 67.5, 0.125),
    "right_elbow": ((0, -1, 1), (-90, 50), 1, 2, 0.006, 45, 0.2857),
    "left_shoulder1": ((-2, 1, -1), (-90, 70), 5, 10, 0.01, 67.5, 0.125),
    "left_shoulder2": ((0, -1, -1), (-90, 70), 5, 10, 0.01, 67.5, 0.125),
    "left_elbow": ((0, -1, -1), (-90, 50), 1, 2, 0.006, 45, 0.2857),
}
MASSES = {  # kg; right and left are alike
    "torso": 5.853834,
    "head": 3.053628,
    "lower_waist": 2.261947,
    "pelvis": 6.616194,
    "thigh": 4.751751,
    "shin": 2.755696,
    "foot": 1.131141,
    "upper_arm": 1.661080,
    "lower_arm": 0.961458,
    "hand": 0.268083,
}
NAMES = list(JOINTS)
GEARS = np.array([row[5] for row in JOINTS.values()])
EFFORT = GEARS / 135
