"""Emulates the RTDE server of a Universal Robots controller: python3 ur_controller.py ADDRESS

Protocol: "Real-Time Data Exchange (RTDE) guide", Universal Robots. Sends states of one pose at the requested rate.
"""

import socket
import struct
import sys
import time

PORT = 30004
TYPES = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D", "actual_qd": "VECTOR6D"}
VALUES = {"actual_q": [0.1 * ix - 0.2 for ix in range(6)], "actual_qd": [0.01 * ix for ix in range(6)]}


def receive(connection, n):
    data = b""
    while len(data) < n:
        part = connection.recv(n - len(data))
        if not part:
            raise ConnectionError("closed")
        data += part
    return data


def send(connection, kind, payload):
    connection.sendall(struct.pack(">HB", len(payload) + 3, ord(kind)) + payload)


def serve(connection):
    names, rate_hz, n_states = [], 125.0, None
    start_secs = time.monotonic()
    while True:
        if n_states is not None:
            secs = n_states / rate_hz
            connection.settimeout(max(1e-4, start_secs + secs - time.monotonic()))
        try:
            size, kind = struct.unpack(">HB", receive(connection, 3))
        except TimeoutError:
            fields = {**VALUES, "timestamp": [5000.0 + secs]}
            numbers = [number for name in names for number in fields[name]]
            send(connection, "U", struct.pack(f">B{len(numbers)}d", 1, *numbers))
            n_states += 1
            continue
        connection.settimeout(None)
        payload = receive(connection, size - 3)
        match chr(kind):
            case "V":
                send(connection, "V", struct.pack(">B", payload == struct.pack(">H", 2)))
            case "v":
                send(connection, "v", struct.pack(">4I", 5, 15, 0, 0))
            case "O":
                (rate_hz,) = struct.unpack(">d", payload[:8])
                names = [name for name in payload[8:].decode().split(",") if name]
                types = ",".join(TYPES.get(name, "NOT_FOUND") for name in names)
                send(connection, "O", b"\x01" + types.encode())
            case "S":
                send(connection, "S", b"\x01")
                start_secs, n_states = time.monotonic(), 0
            case "P":
                send(connection, "P", b"\x01")
                n_states = None


def main():
    with socket.create_server((sys.argv[1], PORT)) as server:
        print("listening", flush=True)
        while True:
            connection, _ = server.accept()
            try:
                serve(connection)
            except ConnectionError:
                pass


main()
