#!/usr/bin/env python3
"""Interrupts commands at random moments and checks that nothing captured is lost.

    scripts/interrupt.py target/release/fieldrig FOLDER CASE train|run|record [-n 20] [--seed 1] [--method splat] [--no-hangup]

CASE is one of
    close   the terminal closes at a random moment; with --no-hangup, no SIGHUP is sent, as after a broken connection
    head    the reader of stdout closes the pipe after one line
    full    stdout and stderr are /dev/full
    disk    the output folder is a tmpfs of 6 MB (needs root)
    kill    train or run: SIGKILL at a random moment after the first checkpoint; the run is then resumed without flags. Training must
            end with the hash of an uninterrupted run, and a live run must keep its keyframes

A trial passes if its recording can be read and its model, or a checkpoint, can be loaded. Files of failed trials are kept in FOLDER.
"""

import argparse
import hashlib
import json
import os
import pty
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

PATIENCE_SECS = 300
# Limits that let a model train within seconds, even without a GPU.
SMALL = ["--max-splats", "2000"]
# Files that the hash of a saved model covers, in this order.
MODEL_FILES = ["model.json", "splats.ply", "mesh.ply", "mesh.glb", "field.blocks", "field.nerf"]
# Text that each command prints with its first keyframe or image.
FIRST_WORDS = {"train": b"step", "run": b"step", "record": b"color images"}


def expect(condition, message):
    if not condition:
        raise AssertionError(message)


class Trial:
    def __init__(self, args, n):
        self.args, self.random = args, random.Random(args.seed * 1000 + n)
        self.exe, self.rig = Path(args.fieldrig).resolve(), Path(args.rig).resolve()
        self.data = Path(args.folder).resolve() / "data.mcap"
        self.folder = self.data.parent / f"{args.case}-{args.command}-{n}"
        shutil.rmtree(self.folder, ignore_errors=True)
        self.out = self.folder / "out"
        self.rescued = self.folder / "tmp"
        for made in [self.out, self.rescued]:
            made.mkdir(parents=True)

    def fieldrig(self, *args, codes=(0,)):
        """Runs a command that must exit with one of `codes`. Returns the finished process."""
        done = subprocess.run([self.exe, *map(str, args)], capture_output=True, text=True, timeout=PATIENCE_SECS)
        expect(done.returncode in codes, f"{' '.join(map(str, args))}: {done.stderr[-1500:]}")
        return done

    def command(self, seconds):
        model, recording = ["--out", self.out / "model"], self.out / "run.mcap"
        live = ["--listen", "127.0.0.1:0", "--when-done", "exit"]
        words = {
            "train": ["train", self.data, "--seconds", seconds, *SMALL, *model],
            "run": ["run", self.rig, "--sim", "--seconds", seconds, *SMALL, *live, "--record", recording, *model],
            "record": ["record", self.rig, "--sim", "--seconds", seconds, "--out", recording],
        }[self.args.command]
        return [self.exe, *map(str, words)]

    def start(self, command, **streams):
        environment = {**os.environ, "TMPDIR": str(self.rescued)}
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, env=environment, **streams)

    def check(self):
        """Checks that the files written by the command can be read. Returns a summary."""
        if self.args.command != "train":
            recording = self.check_recording()
        if self.args.command == "record":
            return recording
        models = [self.out / "model", *self.rescued.iterdir()]
        saved = [model for model in models if (model / "splats.ply").is_file()]
        if saved:
            self.fieldrig("export", saved[0], "--to", "spz", "--out", self.folder / "read.spz")
            return f"the model in {saved[0].name} can be loaded"
        expect((self.out / "model/training.ckpt").is_file(), "neither a model nor a checkpoint")
        self.fieldrig("train", self.data, "--resume", self.out / "model", "--out", self.folder / "resumed")
        return "training resumes from the checkpoint"

    def check_recording(self):
        """Checks that the recording can be read and, after a full disk, has as many samples as the command reported."""
        recording = self.out / "run.mcap"
        output = self.folder / "output.txt"
        printed = output.read_text() if output.exists() else ""
        if not recording.exists():
            expect("No space left" in printed, f"no recording: {printed[-1500:]}")
            return "no space for a single sample"
        read = self.fieldrig("export", recording, "--to", "nerfstudio", "--out", self.folder / "read", codes=(0, 1, 3))
        cut_off = re.search(r"truncated after (\d+) readable samples", read.stderr)
        if "no keyframe to export" in read.stderr and "samples) are saved" in printed:
            return "enough space for joint states, but not for an image"
        if not cut_off:
            expect(read.returncode == 0, read.stderr[-1500:])
            return "the recording can be read"
        if not printed:
            return f"{cut_off[1]} samples can be read"
        expect(f"({cut_off[1]} samples)" in printed, f"{cut_off[0]}, but the command printed: {printed[-1500:]}")
        return f"{cut_off[1]} samples, as reported"

    def close(self):
        """Closes the terminal at a random moment after the first keyframe."""
        ours, theirs = pty.openpty()
        command = self.command(60)
        if not self.args.no_hangup:
            command = ["setsid", "--ctty", *command]
        process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=self.args.no_hangup)
        os.close(theirs)
        text, close_at = b"", None
        while close_at is None or time.monotonic() < close_at:
            text += os.read(ours, 65536)
            if close_at is None and FIRST_WORDS[self.args.command] in text:
                wait_secs = self.random.uniform(0.0, self.args.within)
                close_at = time.monotonic() + wait_secs
        os.close(ours)
        closed = time.monotonic()
        if self.args.no_hangup:  # Without SIGHUP, the command would run for the full minute.
            time.sleep(3.0)
            expect(process.poll() is None, "the process ended when its terminal closed")
            process.send_signal(signal.SIGINT)
        code = process.wait(PATIENCE_SECS)
        expect(code == 3, f"exit code {code}: {text[-1500:]}")
        return f"closed {wait_secs:.1f} s after the first keyframe, ended after {time.monotonic() - closed:.1f} s"

    def head(self):
        command = [*self.command(self.random.uniform(2, 8)), "--json"]
        process = self.start(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        line = process.stdout.readline()
        process.stdout.close()
        code = process.wait(PATIENCE_SECS)
        expect(code in (0, 3), f"exit code {code} after {line}")
        return f"exit code {code}"

    def full(self):
        with open("/dev/full", "w") as full:
            code = self.start(self.command(self.random.uniform(2, 8)), stdout=full, stderr=full).wait(PATIENCE_SECS)
        expect(code == 3, f"exit code {code}")
        return "exit code 3"

    def disk(self):
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", self.out], check=True)
        # This fills a random part of the disk, so that writing fails at a different file in each
        # trial.
        (self.out / "filler").write_bytes(bytes(self.random.randrange(6 << 20)))
        command = self.command(10)
        process = self.start(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        text = process.communicate(timeout=PATIENCE_SECS)[0].decode()
        (self.folder / "output.txt").write_text(text)
        expect("panicked" not in text, text[-1500:])
        return f"exit code {process.returncode}"

    def kill(self):
        return self.kill_train() if self.args.command == "train" else self.kill_run()

    def kill_after_checkpoint(self, process, ends_after_secs):
        """Kills a run at a random moment after its first checkpoint. Returns that moment, and whether the run was still running."""
        begun = time.monotonic()
        while not (self.out / "model/training.ckpt").exists():
            expect(process.poll() is None, "the process ended before its first checkpoint")
            time.sleep(0.01)
        wait_secs = self.random.uniform(0.0, max(begun + ends_after_secs - time.monotonic(), 0.2))
        time.sleep(wait_secs)
        process.send_signal(signal.SIGKILL)
        return wait_secs, process.wait() == -signal.SIGKILL

    def kill_train(self):
        steps = ["--steps", str(self.args.steps), "--method", self.args.method, "--checkpoint-secs", "1"]
        # The test images are few and small, because evaluation takes most of the time without a
        # GPU.
        more = ["--scale", "0.25", "--holdout", "30", *(SMALL if self.args.method == "splat" else [])]
        command = [self.exe, "train", self.data, *steps, *more, "--json", "--out"]
        uninterrupted = self.data.parent / f"whole-{self.args.method}"
        summary = uninterrupted.with_suffix(".json")
        if not summary.exists():
            begun = time.monotonic()
            done = json.loads(self.fieldrig(*command[1:], uninterrupted).stdout.splitlines()[-1])
            summary.write_text(json.dumps({"sha256": done["checkpoint_sha256"], "secs": time.monotonic() - begun}))
        expected = json.loads(summary.read_text())
        process = self.start([*command, self.out / "model"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_secs, was_killed = self.kill_after_checkpoint(process, expected["secs"])
        done = json.loads(self.fieldrig("train", self.data, "--resume", self.out / "model", "--json").stdout.splitlines()[-1])
        if done["event"] == "finished":  # Killed after its model was saved.
            done, was_killed = {"checkpoint_sha256": self.sha256_of_model()}, False
        expect(done["checkpoint_sha256"] == expected["sha256"], f"hash differs: {done}")
        return f"killed {wait_secs:.1f} s after the first checkpoint" if was_killed else "killed after its end"

    def sha256_of_model(self):
        """The hash as in report.json, which is missing if the run was killed while it scored its model."""
        sha256 = hashlib.sha256()
        for file in [self.out / "model" / name for name in MODEL_FILES]:
            if file.exists():
                sha256.update(f"{file.name} {file.stat().st_size}\n".encode() + file.read_bytes())
        return sha256.hexdigest()

    def kill_run(self):
        process = self.start(self.command(12), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_secs, was_killed = self.kill_after_checkpoint(process, 12.0)
        expect(was_killed, "the process had already ended")
        n_kept = len(list((self.out / "model/keyframes").glob("*.keyframe")))
        live = ["--listen", "127.0.0.1:0", "--when-done", "exit"]
        self.fieldrig("run", self.rig, "--resume", self.out / "model", *live, codes=(0, 3))
        with open(self.out / "model/keyframes.txt") as keyframes:
            n_keyframes = sum(not line.startswith("#") for line in keyframes)
        expect(n_keyframes >= n_kept, f"{n_kept} keyframes before, {n_keyframes} after")
        return f"killed {wait_secs:.1f} s after the first checkpoint with {n_kept} keyframes, {n_keyframes} at the end"

    def run(self):
        try:
            result = getattr(self, self.args.case)()
            if (self.args.case, self.args.command) != ("kill", "train"):
                result += "; " + self.check()
        finally:
            if self.args.case == "disk":
                subprocess.run(["umount", "--lazy", self.out], check=False)
        return result


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fieldrig", help="path of the fieldrig binary")
    parser.add_argument("folder", help="folder for the trials and their training data, which is recorded if missing")
    parser.add_argument("case", choices=["close", "head", "full", "disk", "kill"])
    parser.add_argument("command", choices=["train", "run", "record"])
    parser.add_argument("-n", type=int, default=20, help="trials (default 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rig", default="rigs/static-arm.toml")
    parser.add_argument("--within", type=float, default=10.0, help="the terminal closes at most this many seconds after the first keyframe")
    parser.add_argument("--no-hangup", action="store_true", help="send no SIGHUP when the terminal closes")
    parser.add_argument("--method", default="splat", help="for kill")
    parser.add_argument("--steps", type=int, default=300, help="for kill")
    args = parser.parse_args()
    if args.case == "kill" and args.command == "record":
        parser.error("the case kill requires the command train or run")
    data = Path(args.folder).resolve() / "data.mcap"
    data.parent.mkdir(parents=True, exist_ok=True)
    if not data.exists():
        record = [args.fieldrig, "record", args.rig, "--sim", "--seconds", "6", "--out", data]
        code = subprocess.run(record, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
        expect(code in (0, 3), f"record ended with exit code {code}")  # Exit code 3: a slow computer may drop images.
    n_passed = 0
    for n in range(args.n):
        trial = Trial(args, n)
        try:
            print(f"{args.case} {args.command} {n}: {trial.run()}", flush=True)
            shutil.rmtree(trial.folder)
            n_passed += 1
        except (AssertionError, OSError, subprocess.SubprocessError) as error:
            print(f"{args.case} {args.command} {n}: FAILED: {error}", flush=True)
    print(f"{n_passed} of {args.n} passed", flush=True)
    sys.exit(n_passed != args.n)


if __name__ == "__main__":
    main()
