"""Sends joint states to fieldrig as JSON datagrams (docs/reference/udp.md). Needs only the standard library.

The programs in this folder use this module. A program of your own, such as a control loop, can use it as well:

    sender = JointSender()                             # to fieldrig on this computer
    sender.send(["joint1", "joint2"], [0.1, -0.5])     # rad or m; names in any order
"""

import argparse
import ipaddress
import json
import math
import socket
import time

DEFAULT_ADDRESS = ("127.0.0.1", 7011)  # default of arm.address in rig files


class DatagramSender:
    """Sends datagrams from one port, so that fieldrig can ignore other senders."""

    def __init__(self, address):
        host = ipaddress.ip_address(address[0])
        self._address = address
        # Name of the clock time.monotonic_ns() for fieldrig. CLOCK_MONOTONIC has another zero on every computer.
        self.own_clock = "monotonic" if host.is_loopback else "device"
        self._socket = socket.socket(socket.AF_INET if host.version == 4 else socket.AF_INET6, socket.SOCK_DGRAM)
        self._seq = 0

    def send(self, kind, fields, stamp_nanos=None, clock="device"):
        """Sends a datagram of this kind with these fields; stamp_nanos and clock are as for JointSender.send()."""
        if stamp_nanos is None:
            stamp_nanos, clock = time.monotonic_ns(), self.own_clock
        datagram = {"kind": kind, "version": 1, "seq": self._seq, "clock": clock, "stamp_nanos": int(stamp_nanos)}
        self._socket.sendto(json.dumps(datagram | fields).encode(), self._address)
        self._seq += 1


class JointSender:
    """Sends joint states."""

    def __init__(self, address=DEFAULT_ADDRESS):
        self._sender = DatagramSender(address)
        self.own_clock = self._sender.own_clock

    def send(self, names, position, velocity=(), effort=(), stamp_nanos=None, clock="device"):
        """Sends one state: position in rad or m, velocity in rad/s or m/s, effort in N m or N.

        The lists have one number per name; velocity and effort may be empty. stamp_nanos is the time of measurement
        on a clock that runs at a constant rate. Without it, the state was measured now. clock is "monotonic" if
        stamp_nanos is CLOCK_MONOTONIC of the computer on which fieldrig runs, as in time.monotonic_ns().
        """
        state = {"names": list(names), "position": list(position), "velocity": list(velocity), "effort": list(effort)}
        self._sender.send("joints", state, stamp_nanos, clock)


class RateLimit:
    """Lets at most `rate_hz` events per second pass."""

    def __init__(self, rate_hz):
        self._period_secs = 1 / rate_hz
        self._next_secs = None

    def is_due(self):
        """Whether the event that happens now may pass."""
        now_secs = time.monotonic()
        if self._next_secs is None:
            self._next_secs = now_secs
        if now_secs < self._next_secs:
            return False
        self._next_secs = max(self._next_secs + self._period_secs, now_secs)
        return True


def ticks(rate_hz):
    """Yields at this rate. Ticks that are missed because the caller was too slow are left out."""
    next_tick = time.monotonic()
    while True:
        yield
        next_tick = max(next_tick + 1 / rate_hz, time.monotonic())
        time.sleep(max(0.0, next_tick - time.monotonic()))


def arguments(description, rate_hz, address=DEFAULT_ADDRESS, key="arm.address"):
    """A parser with the flags that all senders have. The rig file has the address in this key."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--to", type=_address, default=address, metavar="IP:PORT",
                        help=f"{key} in the rig file (default: {address[0]}:{address[1]})")
    parser.add_argument("--rate", type=_rate, default=rate_hz, metavar="HZ",
                        help=f"datagrams per second (default: {rate_hz})")
    return parser


def _address(text):
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"{text!r} is not an IP address and a port, such as 127.0.0.1:7011")
    try:
        return str(ipaddress.ip_address(host.strip("[]"))), int(port)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _rate(text):
    rate_hz = float(text)
    if not (math.isfinite(rate_hz) and 0 < rate_hz <= 2000):
        raise argparse.ArgumentTypeError(f"{text} Hz is not a rate above 0 and up to 2000 Hz")
    return rate_hz
