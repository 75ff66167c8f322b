"""Who sits where, whom they help, and what they did since the timestep began. Time comes in as an argument.

A seat belongs to whoever knows its key. A client is one open page; a person whose page is reloaded or loses its
connection comes back with the key, as another client.
"""

import hmac
import secrets
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np

from fleetjax.console.engine import EMPTY, PERSON, SIMULATED, Inputs, View

LATEST = 10  # timesteps that an action may lag behind the picture it answers


class Refused(Exception):
    """What a client asked for is not possible; the message is for the person."""


@dataclass
class Seat:
    """One seat.

    Attributes:
        key: what its owner knows; empty = nobody sits there.
        client: the page that is open on it; None = the connection is lost.
        heard: when its owner was last heard of (s).
        robot: whom the owner helps at this timestep, -1 = nobody.
        resetting: whether that robot is in violation.
        since: the timestep at which this help began; with `robot`, it tells one help from the next.
        action: f32[A] given for this timestep.
        confirmed: whether the owner wants the hard reset.
    """

    key: str = ""
    client: Hashable | None = None
    heard: float = 0.0
    robot: int = -1
    resetting: bool = False
    since: int = -1
    action: np.ndarray | None = field(default=None, repr=False)
    confirmed: bool = False


class Seats:
    """The M seats of a console.

    Args:
        number: M.
        simulated: whether the simulated supervisor plays seats that nobody takes; else they stay empty.
        timeout: seconds of silence after which a seat is free again.
    """

    def __init__(self, number: int, *, simulated: bool, timeout: float):
        self.seats = [Seat() for _ in range(number)]
        self.unclaimed = SIMULATED if simulated else EMPTY
        self.timeout = timeout

    def claim(
        self, client: Hashable, now: float, *, key: str = "", seat: int | None = None
    ) -> tuple[int, str, Hashable | None]:
        """Sit down: in the seat of that key, else in the seat asked for, else in the first free one.

        Returns:
            The seat, its key, and the client that had it open until now, if there is another.

        Raises:
            Refused: if it is taken, none is free, or the client has another.
        """
        mine, kept = self.of(client), self._kept(key)
        if mine not in (None, kept):
            raise Refused("you already have a seat")
        if kept is not None:
            old = self.seats[kept]
            before, old.client, old.heard, old.action = old.client, client, now, None
            return kept, old.key, before if before is not client else None
        free = [i for i, other in enumerate(self.seats) if not other.key]
        if seat is not None and seat not in range(len(self.seats)):
            raise Refused(f"there is no seat {seat + 1}")
        if seat is not None and seat not in free:
            raise Refused(f"seat {seat + 1} is taken")
        if not free:
            raise Refused("every seat is taken")
        chosen = free[0] if seat is None else seat
        self.seats[chosen] = Seat(secrets.token_urlsafe(16), client, now)
        return chosen, self.seats[chosen].key, None

    def _kept(self, key: str) -> int | None:
        """Return the seat that belongs to a key."""
        for i, seat in enumerate(self.seats):
            if seat.key and hmac.compare_digest(seat.key.encode(), key.encode()):
                return i
        return None

    def of(self, client: Hashable) -> int | None:
        """Return the seat that a client has open."""
        return next((i for i, seat in enumerate(self.seats) if seat.key and seat.client is client), None)

    def hear(self, client: Hashable, now: float) -> None:
        """Note that a client is there."""
        seat = self.of(client)
        if seat is not None:
            self.seats[seat].heard = now

    def drop(self, client: Hashable, now: float) -> None:
        """Note that a connection is lost. The seat stays its owner's until the timeout; what was not used is forgotten."""
        seat = self.of(client)
        if seat is not None:
            self.seats[seat].client, self.seats[seat].heard, self.seats[seat].action = None, now, None

    def leave(self, client: Hashable) -> None:
        """Stand up."""
        seat = self.of(client)
        if seat is not None:
            self.seats[seat] = Seat()

    def expire(self, now: float) -> list[Hashable]:
        """Free the seats of those who were silent for too long; return the clients that still have one open."""
        late = [i for i, seat in enumerate(self.seats) if seat.key and now - seat.heard > self.timeout]
        clients = [self.seats[i].client for i in late]
        for i in late:
            self.seats[i] = Seat()
        return [client for client in clients if client is not None]

    def kinds(self) -> np.ndarray:
        """Return u8[M], who sits in each seat."""
        return np.array([PERSON if seat.key else self.unclaimed for seat in self.seats], np.uint8)

    def assign(self, view: View, kinds: np.ndarray) -> None:
        """Tell everyone whom they help at a timestep that began with `kinds`. An action for the same help stays given."""
        for seat, kind, robot in zip(self.seats, kinds, map(int, view.robot), strict=True):
            robot = robot if kind == PERSON and seat.key else -1
            resetting = robot >= 0 and bool(view.resetting[robot])
            if (robot, resetting) != (seat.robot, seat.resetting):
                seat.robot, seat.resetting, seat.since = robot, resetting, view.timestep
                seat.action, seat.confirmed = None, False

    def act(self, client: Hashable, robot: int, since: int, lag: int, action: np.ndarray) -> None:
        """Take a person's action for the timestep; the newest counts.

        Args:
            client: whose.
            robot: for which robot.
            since: when the help began that it belongs to.
            lag: timesteps since the picture that it answers.
            action: f32[A].

        Raises:
            Refused: if the robot is not theirs, or waits for a reset, or the action comes too late.
        """
        seat = self._helping(client, robot, since)
        if seat.resetting:
            raise Refused(f"robot {robot} has to be reset first")
        if not 0 <= lag <= LATEST:
            raise Refused("that was too late")
        seat.action = action

    def confirm(self, client: Hashable, robot: int, since: int) -> None:
        """Begin the hard reset that a person wants; it continues until it is completed.

        Raises:
            Refused: if the robot is not theirs, or is in no violation.
        """
        seat = self._helping(client, robot, since)
        if not seat.resetting:
            raise Refused(f"robot {robot} needs no reset")
        seat.confirmed = True

    def _helping(self, client: Hashable, robot: int, since: int) -> Seat:
        number = self.of(client)
        if number is None:
            raise Refused("you have no seat")
        seat = self.seats[number]
        if (seat.robot, seat.since) != (robot, since) or robot < 0:
            raise Refused(f"robot {robot} is not yours now")
        return seat

    def collect(self, kinds: np.ndarray, action_size: int) -> Inputs:
        """Return what was done at the timestep that began with `kinds`; actions are used up, confirmed resets continue."""
        there = [kind == PERSON and seat.robot >= 0 for seat, kind in zip(self.seats, kinds, strict=True)]
        pairs = list(zip(self.seats, there, strict=True))
        actions = [seat.action if yes and seat.action is not None else np.zeros(action_size, np.float32) for seat, yes in pairs]
        given = np.array([yes and seat.action is not None for seat, yes in pairs])
        confirmed = np.array([yes and seat.confirmed for seat, yes in pairs])
        for seat in self.seats:
            seat.action = None
        return Inputs(kinds, given, np.stack(actions), confirmed)
