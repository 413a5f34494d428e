#!/usr/bin/env python3
"""Runs a command repeatedly while all processors are taken away in bursts, as a busy host does to a virtual machine.

usage: steal-processors.py [--times N] [--share F] [--longest S] [--seed N] COMMAND [ARGUMENT]...

    --times N      how often the command runs [default: 30]
    --share F      share of the time in which no processor is available [default: 0.11]
    --longest S    longest burst in seconds [default: 0.6]
    --seed N       seed of the lengths of the bursts [default: 1]

Prints how often the command failed, and the output of each failure. Needs root: the bursts run with real-time priority.
A test that fails here depends on the speed of the machine. The kernel must not limit real-time tasks
(/proc/sys/kernel/sched_rt_runtime_us is set to -1 meanwhile).
"""

import argparse
import multiprocessing
import os
import pathlib
import random
import subprocess
import sys
import time

# This priority is higher than any priority that the tests use.
PRIORITY = 97
RT_LIMIT = pathlib.Path("/proc/sys/kernel/sched_rt_runtime_us")


def steal(processor, share, longest_secs, seed, start):
    """Occupies a processor in bursts. All processors use the same seed and clock, so the bursts coincide."""
    os.sched_setaffinity(0, [processor])
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    bursts = random.Random(seed)
    at = start
    while True:
        # Most bursts are short, and some are long. Their mean is a quarter of the longest burst.
        burst_secs = longest_secs * bursts.random() ** 3
        pause_secs = longest_secs / 4 * (1 / share - 1) * 2 * bursts.random()
        at += pause_secs
        time.sleep(max(at - time.monotonic(), 0))
        at += burst_secs
        while time.monotonic() < at:
            pass


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--share", type=float, default=0.11)
    parser.add_argument("--longest", type=float, default=0.6)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("command", nargs=argparse.REMAINDER)
    arguments = parser.parse_args()
    if not arguments.command:
        parser.error("no command")
    try:
        limit = RT_LIMIT.read_text()
        RT_LIMIT.write_text("-1")
    except OSError as error:
        sys.exit(f"steal-processors: cannot change {RT_LIMIT}: {error}; run as root")
    start = time.monotonic()
    settings = (arguments.share, arguments.longest, arguments.seed, start)
    thieves = [
        multiprocessing.Process(target=steal, args=(processor, *settings), daemon=True)
        for processor in os.sched_getaffinity(0)
    ]
    n_failed = 0
    try:
        for thief in thieves:
            thief.start()
        for n in range(1, arguments.times + 1):
            run = subprocess.run(arguments.command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False)
            if run.returncode != 0:
                n_failed += 1
                print(f"---- run {n} failed (exit status {run.returncode})")
                print(run.stdout.decode(errors="replace"))
            print(f"{n - n_failed} passed, {n_failed} failed after {time.monotonic() - start:.0f} s", flush=True)
    finally:
        for thief in thieves:
            thief.kill()
        RT_LIMIT.write_text(limit)
    sys.exit(n_failed > 0)


if __name__ == "__main__":
    main()
