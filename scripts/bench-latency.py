#!/usr/bin/env python3
"""Measures the latency of pictures from a running `fieldrig run`, and how much they slow down training.

Clients request pictures back to back and measure the time from sending a request until the last
stage has arrived completely. Prints one JSON object; needs only Python 3.9.

    fieldrig run rigs/static-arm.toml --sim &
    scripts/bench-latency.py --clients 0,1,8 --seconds 10

`--clients 0` measures training alone. Every client requests the initial view of the scene.
"""

import argparse
import base64
import json
import math
import multiprocessing
import os
import queue
import socket
import struct
import sys
import time
import urllib.request

TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
REPLY_TIMEOUT_S = 60.0


class WebSocket:
    """A client of RFC 6455 without extensions."""

    def __init__(self, host, port, path, timeout_s):
        self.socket = socket.create_connection((host, port), timeout=timeout_s)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(
            f"GET {path} HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        self.reader = self.socket.makefile("rb", buffering=1 << 20)
        status = self.reader.readline()
        if b" 101 " not in status:
            raise ConnectionError(f"the server rejected the WebSocket: {status.decode(errors='replace').strip()}")
        while self.reader.readline() not in (b"\r\n", b""):
            pass

    def _read(self, n_bytes):
        data = self.reader.read(n_bytes)
        if len(data) != n_bytes:
            raise ConnectionError("the server closed the connection")
        return data

    def send(self, opcode, payload):
        mask = os.urandom(4)
        length = len(payload)
        header = bytes([0x80 | opcode])
        if length < 126:
            header += bytes([0x80 | length])
        elif length < 1 << 16:
            header += bytes([0x80 | 126]) + struct.pack(">H", length)
        else:
            header += bytes([0x80 | 127]) + struct.pack(">Q", length)
        masked = bytes(byte ^ mask[ix % 4] for ix, byte in enumerate(payload))
        self.socket.sendall(header + mask + masked)

    def receive(self):
        """The next whole message: opcode and payload."""
        opcode, parts = None, []
        while True:
            first, second = self._read(2)
            length = second & 0x7F
            if length == 126:
                (length,) = struct.unpack(">H", self._read(2))
            elif length == 127:
                (length,) = struct.unpack(">Q", self._read(8))
            payload = self._read(length)
            code = first & 0x0F
            if code == PING:
                self.send(PONG, payload)
            elif code == CLOSE:
                raise ConnectionError("the server closed the connection")
            elif code != PONG:
                opcode = code or opcode
                parts.append(payload)
                if first & 0x80:
                    return opcode, b"".join(parts)


def status_of(address):
    with urllib.request.urlopen(f"http://{address[0]}:{address[1]}/status", timeout=REPLY_TIMEOUT_S) as reply:
        return json.load(reply)


def wait_for_training(address, timeout_s):
    """Waits until the run has made at least one training step."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        try:
            status = status_of(address)
            if status.get("step", 0) > 0:
                return status
        except OSError:
            pass
        time.sleep(0.1)
    sys.exit(f"bench-latency: no training step at {address[0]}:{address[1]} within {timeout_s:g} s")


def ask(args, view):
    """The fields of a request, without its id."""
    request = {
        "type": "render",
        "size_px": [args.size, args.size],
        "world_from_camera": view,
        "projection": {"kind": "pinhole", "vertical_fov_rad": math.radians(60.0)},
        "outputs": ["color", "depth"] if args.outputs == "both" else [args.outputs],
    }
    if args.method:
        request["method"] = args.method
    if args.stages:
        request["stages"] = [float(scale) for scale in args.stages.split(",")]
    return request


def run_client(args, address, begin, end, results):
    """Requests pictures back to back from `begin` to `end`, in seconds of the monotonic clock."""
    try:
        results.put(measure(args, address, begin, end))
    except (OSError, ConnectionError, ValueError) as error:
        results.put({"error": str(error)})


def measure(args, address, begin, end):
    link = WebSocket(*address, "/ws", REPLY_TIMEOUT_S)
    view = None
    while view is None:
        opcode, payload = link.receive()
        if opcode == TEXT:
            message = json.loads(payload)
            if message["type"] == "scene":
                view = message["world_from_camera"]
    request = ask(args, view)
    time.sleep(max(0.0, begin - time.monotonic()))
    first_millis, full_millis, n_stages, errors = [], [], 0, []
    request_id = 0
    while time.monotonic() < end and len(errors) < 10:
        request_id += 1
        sent = time.monotonic()
        link.send(TEXT, json.dumps({**request, "id": request_id}).encode())
        is_first = True
        while True:
            opcode, payload = link.receive()
            if opcode == TEXT:
                message = json.loads(payload)
                if message["type"] == "error":
                    errors.append(message["message"])
                    break
                continue
            (length,) = struct.unpack_from("<I", payload)
            header = json.loads(payload[4 : 4 + length])
            if header["type"] != "picture" or header["id"] != request_id:
                continue
            took_millis = 1e3 * (time.monotonic() - sent)
            n_stages += 1
            if is_first:
                first_millis.append(took_millis)
                is_first = False
            if header["last"]:
                full_millis.append(took_millis)
                break
    link.send(TEXT, b'{"type": "goodbye"}')
    return {"first_millis": first_millis, "full_millis": full_millis, "n_stages": n_stages, "errors": errors}


def quantile(values, share):
    """The nearest-rank quantile; None for an empty list."""
    ordered = sorted(values)
    return round(ordered[max(0, math.ceil(share * len(ordered)) - 1)], 2) if ordered else None


def steps_of(status, method):
    for model in [status, *status.get("others", [])]:
        if method is None or model.get("method") == method:
            return model["step"], model.get("step_millis"), model.get("primitives")
    sys.exit(f"bench-latency: the run trains no model with the method {method!r}")


def phase(args, address, n_clients):
    begin = time.monotonic() + 1.0
    end = begin + args.seconds
    results = multiprocessing.Queue()
    clients = [
        multiprocessing.Process(target=run_client, args=(args, address, begin, end, results), daemon=True)
        for _ in range(n_clients)
    ]
    for client in clients:
        client.start()
    time.sleep(max(0.0, begin - time.monotonic()))
    # The status is published four times a second: steps are counted between its first and last change.
    samples = []
    while time.monotonic() < end:
        status = status_of(address)
        if not samples or status["seconds"] != samples[-1][1]["seconds"]:
            samples.append((time.monotonic(), status))
        time.sleep(0.02)
    parts = []
    for _ in clients:
        try:
            parts.append(results.get(timeout=2 * REPLY_TIMEOUT_S))
        except queue.Empty:
            parts.append({"error": "the client did not stop"})
    for client in clients:
        client.join(timeout=5)
        client.terminate()
    errors = [part["error"] for part in parts if "error" in part]
    parts = [part for part in parts if "error" not in part]
    errors += [error for part in parts for error in part["errors"]]
    full = [ms for part in parts for ms in part["full_millis"]]
    first = [ms for part in parts for ms in part["first_millis"]]
    (from_s, before), (to_s, after) = samples[0], samples[-1]
    step_before, _, _ = steps_of(before, args.method)
    step_after, step_millis, primitives = steps_of(after, args.method)
    spent_s = to_s - from_s
    return {
        "clients": n_clients,
        "pictures": len(full),
        "pictures_per_s": round(len(full) / args.seconds, 2),
        "stages_per_picture": round(sum(part["n_stages"] for part in parts) / len(full), 2) if full else None,
        "full_p50_millis": quantile(full, 0.5),
        "full_p90_millis": quantile(full, 0.9),
        "full_p99_millis": quantile(full, 0.99),
        "full_max_millis": quantile(full, 1.0),
        "first_stage_p50_millis": quantile(first, 0.5),
        "first_stage_p99_millis": quantile(first, 0.99),
        "steps_per_s": round((step_after - step_before) / spent_s, 2) if spent_s > 0 else None,
        "step_millis": step_millis,
        "primitives": primitives,
        "keyframes": after["keyframes"],
        "state": after["state"],
        "errors": errors[:10],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--listen", default="127.0.0.1:7007", help="address of the running program [%(default)s]")
    parser.add_argument("--clients", default="0,1,8", help="numbers of clients, separated by commas; one measurement each [%(default)s]")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of a measurement [%(default)s]")
    parser.add_argument("--size", type=int, default=1024, help="width and height, pixels [%(default)s]")
    parser.add_argument("--outputs", choices=["color", "depth", "both"], default="both", help="[%(default)s]")
    parser.add_argument("--stages", help="scales separated by commas [the server's defaults]")
    parser.add_argument("--method", help="model to request if the run trains several [the first model]")
    parser.add_argument("--wait", type=float, default=120.0, help="seconds to wait for the first step [%(default)s]")
    parser.add_argument("--after", type=float, default=0.0, help="start after this many seconds of training [%(default)s]")
    args = parser.parse_args()
    host, _, port = args.listen.rpartition(":")
    address = (host, int(port))
    status = wait_for_training(address, args.wait)
    while status["seconds"] < args.after and status["state"] != "finished":
        time.sleep(0.1)
        status = status_of(address)
    phases = [phase(args, address, int(n_clients)) for n_clients in args.clients.split(",")]
    report = {
        "size_px": [args.size, args.size],
        "outputs": args.outputs,
        "stages": args.stages or "default",
        "method": args.method or status["method"],
        "cores": os.cpu_count(),
        "phases": phases,
    }
    print(json.dumps(report, indent=2))
    return 1 if any(phase["errors"] for phase in phases) else 0


if __name__ == "__main__":
    sys.exit(main())
