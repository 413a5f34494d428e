#!/usr/bin/env python3
"""Lets fieldrig drive a base (base.motion.address in rig files). Needs only the standard library.

A program that controls a base uses the class:

    controller = BaseController()                       # listens on 127.0.0.1:7020
    while True:                                         # at 20 Hz or faster
        forward, left, yaw = controller.wanted(measured=(0.1, 0.0, 0.0))   # m/s, m/s, rad/s
        ...                                             # set these velocities

As a program, it controls a simulated base without sideways motion, and sends its poses to fieldrig, so that steering can be
tried without a robot:

    scripts/senders/base_controller.py

docs/reference/udp.md describes the datagrams and what a controller must check.
"""

import argparse
import json
import math
import socket
import time

from joint_sender import DatagramSender, ticks

LISTEN = ("127.0.0.1", 7020)
POSES = ("127.0.0.1", 7009)  # default of base.address in rig files
SESSION_END_NANOS = 1_000_000_000  # silence after which another program may drive the base
MAX_VALID_NANOS = 1_000_000_000  # latest end of a velocity that is accepted
STOP = (0.0, 0.0, 0.0)


class BaseController:
    """Receives velocities, and returns the one that the base must have now."""

    def __init__(self, listen=LISTEN):
        family = socket.AF_INET6 if ":" in listen[0] else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.bind(listen)
        self._socket.setblocking(False)
        self._session = None
        self._seq = 0
        self._heard_nanos = 0
        self._velocity = STOP
        self._expires_nanos = 0

    @property
    def port(self):
        """The port on which it listens."""
        return self._socket.getsockname()[1]

    def wanted(self, measured, fault=None):
        """The velocity that the base must have now: forward and left in m/s, yaw in rad/s.

        measured is the velocity of the base in the same order. fault says why the base cannot move, such as "emergency stop".
        """
        while True:
            try:
                datagram, sender = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionError):
                break
            command = _command(datagram)
            if command:
                refusal = self._obey(command, time.monotonic_ns(), fault)
                self._reply(sender, command, measured, fault, refusal)
        # Without a newer command, the base stops.
        if time.monotonic_ns() > self._expires_nanos or fault:
            self._velocity = STOP
        return self._velocity

    def _obey(self, command, now_nanos, fault):
        """Why the command is refused; None if it is accepted."""
        is_stop = command["velocity"] == STOP
        if command["session"] != self._session:
            is_free = self._session is None or now_nanos - self._heard_nanos > SESSION_END_NANOS
            if not is_free or not is_stop:
                return "another program drives the base, or the first velocity is not zero"
            self._session, self._seq = command["session"], 0
        if command["seq"] <= self._seq:
            return "repeated or overtaken"
        self._seq, self._heard_nanos = command["seq"], now_nanos
        if is_stop or fault:
            self._velocity = STOP
            return None
        if not now_nanos < command["expires_nanos"] <= now_nanos + MAX_VALID_NANOS:
            self._velocity = STOP
            return "expired, or it would last for more than a second"
        self._velocity, self._expires_nanos = command["velocity"], command["expires_nanos"]
        return None

    def _reply(self, sender, command, measured, fault, refusal):
        forward, left, yaw = measured
        reply = {
            "kind": "drive_state", "version": 1, "session": command["session"], "seq": command["seq"],
            "stamp_nanos": time.monotonic_ns(), "forward_m_s": forward, "left_m_s": left, "yaw_rad_s": yaw,
        }  # fmt: skip
        if fault:
            reply["fault"] = fault
        if refusal:
            reply["refusal"] = refusal
        try:
            self._socket.sendto(json.dumps(reply).encode(), sender)
        except OSError:
            pass  # The same as a lost reply: fieldrig repeats a stop until it is confirmed.


def _command(datagram):
    """The fields of a valid command; None if it is not valid."""
    try:
        fields = json.loads(datagram)
        velocity = tuple(float(fields[name]) for name in ("forward_m_s", "left_m_s", "yaw_rad_s"))
        session, seq, expires_nanos = fields["session"], fields["seq"], fields.get("expires_nanos")
        is_known = fields["kind"] == "drive" and fields["version"] == 1
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    is_valid = is_known and all(math.isfinite(number) for number in velocity)
    is_valid = is_valid and isinstance(session, int) and isinstance(seq, int)
    # A velocity without an end would move the base until the next command.
    if not is_valid or (velocity != STOP and not isinstance(expires_nanos, int)):
        return None
    return {"velocity": velocity, "session": session, "seq": seq, "expires_nanos": expires_nanos}


class SimulatedBase:
    """A base on wheels that reaches its velocities with limited acceleration."""

    MAX_ACCELERATION = (0.8, 0.0, 2.0)

    def __init__(self):
        self.velocity = STOP
        self.x_m = self.y_m = self.yaw_rad = 0.0

    def step(self, wanted, secs):
        def toward(now, goal, most):
            return now + min(most, max(-most, goal - now))

        most = [acceleration * secs for acceleration in self.MAX_ACCELERATION]
        self.velocity = tuple(map(toward, self.velocity, wanted, most))
        forward, _, yaw = self.velocity
        self.yaw_rad += yaw * secs
        self.x_m += forward * secs * math.cos(self.yaw_rad)
        self.y_m += forward * secs * math.sin(self.yaw_rad)

    def pose(self):
        half = 0.5 * self.yaw_rad
        return {"xyz_m": [self.x_m, self.y_m, 0.0], "quat_xyzw": [0.0, 0.0, math.sin(half), math.cos(half)]}


def address(text):
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not an IP address and a port, such as 127.0.0.1:7020")
    return host.strip("[]"), int(port)


def main():
    parser = argparse.ArgumentParser(description="Controls a simulated base that fieldrig drives.")
    parser.add_argument("--listen", type=address, default=LISTEN, metavar="IP:PORT",
                        help="base.motion.address in the rig file (default: 127.0.0.1:7020)")
    parser.add_argument("--to", type=address, default=POSES, metavar="IP:PORT",
                        help="base.address in the rig file (default: 127.0.0.1:7009)")
    args = parser.parse_args()
    controller, base, poses = BaseController(args.listen), SimulatedBase(), DatagramSender(args.to)
    print(f"listening on port {controller.port}", flush=True)
    last = time.monotonic()
    for _ in ticks(100):
        now = time.monotonic()
        base.step(controller.wanted(base.velocity), now - last)
        last = now
        poses.send("base", {"world_from_base": base.pose()})


if __name__ == "__main__":
    main()
