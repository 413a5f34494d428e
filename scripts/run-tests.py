#!/usr/bin/env python3
"""Builds all test programs with cargo, runs them, and reports how long each step, program and test took.

usage: run-tests.py [--steps FILE] [--report FILE] [--only REGEX] [--filter TEXT] [--no-doc] [--quick] -- CARGO_ARGUMENT...

    --steps FILE    durations of earlier steps (scripts/timed.sh), reported at the end
    --report FILE   also writes the report to this file, as Markdown
    --only REGEX    runs only the test programs whose name matches, such as `trainer unit` or `viz page`
    --filter TEXT   runs only the tests whose name contains this text
    --no-doc        skips the examples in documentation
    --quick         runs only unit tests, and none that need a GPU

The arguments after `--` are passed to `cargo test`, for example `--workspace --features sim`. Tests that this machine
cannot run report why (tests/support/src/skip.rs); they are counted as skipped and listed at the end.
"""

import argparse
import collections
import json
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time

# Programs that mostly wait for clocks and devices, and are sensitive to timing. They run one after another on the last processor
# beside all other programs, with a higher priority if this user may set it.
BESIDE = ("bench unit", "drivers franka_peers", "drivers unit", "fieldrig hil")
# Tests that need other settings than the rest of their program. Each entry has the program, a part
# of the names of the tests, and the environment. With this vector width, Mesa's software Vulkan has
# subgroups of 16 lanes, so that the kernels for GPUs are tested, too.
SEPARATE = tuple((name, "needs_large_subgroups", {"LP_NATIVE_VECTOR_WIDTH": "512"}) for name in ("gpu unit", "trainer unit"))
# Programs that only compute. They run one after another beside all other programs, with a lower
# priority. They use the time in which the other programs wait for clocks, devices and browsers.
COMPUTING = (
    "trainer unit", "trainer unit needs_large_subgroups", "gpu unit", "gpu unit needs_large_subgroups", "calibration unit",
    "sim rigs", "sim unit", "targets accuracy", "targets photos", "examples in documentation",
)
# Steps by which a priority differs. A program whose priority is lower by 10 gets a tenth of a busy
# processor.
NICE = 10
# Programs that start first, because they take longest. The other programs follow in the order of
# their names. The tests with a browser wait most, so they run while programs that only compute are
# left to fill these times.
FIRST = ("viz viewer", "fieldrig program", "trainer unit")
# With --quick, only programs with unit tests run. The modules in this list are left out, because
# their tests need a GPU. No GPU is visible to the programs, so a test that needs one fails unless
# its module is listed here.
WITHOUT_GPU = {"VK_DRIVER_FILES": "/dev/null", "VK_ICD_FILENAMES": "/dev/null"}
NOT_QUICK = {
    "gpu unit": ("device::tests", "passes::tests", "pipeline::tests", "sort::tests"),
    "trainer unit": (
        "against_twin", "aligned::", "alignment_tests", "checkpoint_tests", "edit_tests",
        "mean_color::", "needs_", "nerf::bench", "nerf::tests", "non_finite_tests", "packing::tests",
        "registry::tests", "splat::chunks", "splat::entry", "splat::trainer", "training_tests", "trial_tests",
        "tsdf::mesh", "tsdf::tests", "view::erased",
    ),
    "session unit": ("session::tests", "recoveries::tests"),
}
N_SLOWEST = 10
# Number of the longest programs in the last line, and maximum length of a message of a failed test.
N_LONGEST = 5
MAX_MESSAGE = 300

TEST_LINE = re.compile(r"test (.+?)(?: - should panic| - compile| - compile fail)? \.\.\. (ok|FAILED|ignored)\b(?:.*<([0-9.]+)s>)?")


class Program:
    """A test program. The results are empty until it has run."""

    def __init__(self, name, command, folder, environment=()):
        self.name, self.command, self.folder = name, command, folder
        self.environment = dict(environment)
        self.secs = self.processor_secs = 0.0
        self.process = None
        self.output_path = None
        self.status = None
        self.output = ""
        # (name, result, seconds)
        self.tests = []
        # Reasons by test.
        self.skipped = {}

    def count(self, result):
        return sum(found == result for _, found, _ in self.tests)

    def counts(self):
        """Numbers of passed, failed and skipped tests."""
        return self.count("ok") - len(self.skipped), self.count("FAILED"), len(self.skipped)

    def has_failed(self):
        return self.status != 0

    def run(self, processors, nice=0):
        """Runs the program on some processors, with a priority that is lower by `nice`."""
        since = time.monotonic()
        # Mesa's software Vulkan runs kernels on the calling thread, which takes a third less
        # computing time than distributing them to other threads. Other threads are not needed,
        # because tests run in parallel.
        environment = dict(os.environ, LP_NUM_THREADS="0", **self.environment)
        # With a single thread, the test harness prints a line in two parts, and the output of the
        # test comes between them.
        environment["RUST_TEST_THREADS"] = str(max(2, os.cpu_count()))
        with tempfile.TemporaryDirectory() as folder, open(pathlib.Path(folder, "output"), "w+b") as output:
            self.output_path = pathlib.Path(folder, "output")
            skipped = pathlib.Path(folder, "skipped")
            environment["FIELDRIG_SKIPPED_TESTS"] = str(skipped)
            # The program gets its own process group, so that `stop` also ends the programs that it
            # starts.
            self.process = subprocess.Popen(
                self.command,
                cwd=self.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                preexec_fn=lambda: (os.setpgrp(), os.sched_setaffinity(0, processors), change_priority(nice)),
            )
            self.wait()
            output.seek(0)
            self.output = output.read().decode(errors="replace")
            if skipped.exists():
                lines = skipped.read_text(errors="replace").splitlines()
                self.skipped = dict(line.split("\t", 1) for line in lines)
        self.secs = time.monotonic() - since
        self.tests = tests_in(self.output)

    def wait(self):
        """Waits for the process, and measures the computing time of it and of the programs that it has waited for."""
        _, status, usage = os.wait4(self.process.pid, 0)
        self.process.returncode = self.status = os.waitstatus_to_exitcode(status)
        self.processor_secs = usage.ru_utime + usage.ru_stime

    def is_running(self):
        return self.process is not None and self.process.returncode is None

    def n_finished(self):
        """Number of tests that have finished so far."""
        try:
            return len([result for _, result, _ in tests_in(self.output_path.read_text(errors="replace")) if result != "ignored"])
        except OSError:
            return 0  # The program has just ended.

    def stop(self):
        """Ends the program and all programs that it has started."""
        if self.is_running():
            os.killpg(self.process.pid, signal.SIGTERM)


def change_priority(nice):
    """Lowers the priority of this process by `nice`. A negative number raises it, if this user may do so."""
    try:
        os.nice(nice)
    except PermissionError:
        pass


def tests_in(output):
    """Name, result and seconds of each test in the output of a program."""
    found = filter(None, map(TEST_LINE.match, output.splitlines()))
    return [(line[1], line[2], float(line[3] or 0)) for line in found]


def panics_in(output, test):
    """Place and first line of the message of each panic in the thread of a test."""
    return re.findall(rf"^thread '{re.escape(test)}'.* panicked at (.+):\n(.*)$", output, re.MULTILINE)


def build(cargo_arguments):
    """Builds all test programs, and returns them."""
    command = ["cargo", "test", "--no-run", "--message-format", "json-render-diagnostics", *cargo_arguments]
    print("+", " ".join(command), flush=True)
    programs = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as cargo:
        for line in cargo.stdout:
            message = json.loads(line) if line.startswith("{") else {}
            if message.get("reason") != "compiler-artifact" or not message["profile"]["test"] or not message["executable"]:
                continue
            folder = pathlib.Path(message["manifest_path"]).parent
            target = message["target"]
            is_unit = target["kind"] != ["test"]
            name = f"{package_name(message['package_id'])} {'unit' if is_unit else target['name']}"
            if is_unit and target["kind"] == ["bin"]:
                name += " (program)"
            arguments = ["-Z", "unstable-options", "--report-time"]
            # The option for times is unstable, and this variable allows it. The variable is not set
            # for cargo, which would compile dependencies again.
            programs.append(Program(name, [message["executable"], *arguments], folder, {"RUSTC_BOOTSTRAP": "1"}))
    if cargo.returncode != 0:
        sys.exit(cargo.returncode)
    rank = {name: number for number, name in enumerate(FIRST)}
    return sorted(programs, key=lambda program: (rank.get(program.name, len(rank)), program.name))


def separated(programs):
    """The programs, with the tests of SEPARATE in programs of their own."""
    extra = []
    for program in programs:
        for name, tests, environment in SEPARATE:
            if program.name == name:
                environment = {**program.environment, **environment}
                extra.append(Program(f"{name} {tests}", [*program.command, tests], program.folder, environment))
                program.command += ["--skip", tests]
    return programs + extra


def quick(programs):
    """The programs with unit tests, without the tests that need a GPU."""
    programs = [program for program in programs if program.name.endswith(" unit")]
    for program in programs:
        program.environment.update(WITHOUT_GPU)
        for tests in NOT_QUICK.get(program.name, ()):
            program.command += ["--skip", tests]
    return programs


def package_name(package_id):
    """`path+file:///folder/trainer#0.1.0` and `path+file:///folder#fieldrig@0.1.0` name packages."""
    path, _, version = package_id.partition("#")
    return version.split("@")[0] if "@" in version else path.rsplit("/", 1)[-1]


def doc_tests(cargo_arguments):
    """The examples in documentation, as one program."""
    return Program("examples in documentation", ["cargo", "test", "--doc", *cargo_arguments], os.getcwd())


class Runner:
    """Runs programs, and prints a line for each."""

    def __init__(self):
        self.lock = threading.Lock()

    def run_all(self, programs, processors, nice=0):
        for program in programs:
            program.run(processors, nice)
            self.print_result(program)

    def print_progress(self, programs):
        """Prints every minute which programs run."""
        while True:
            time.sleep(60)
            with self.lock:
                for program in filter(Program.is_running, programs):
                    print(f"           {program.name} is running, {program.n_finished()} tests so far", flush=True)

    def print_result(self, program):
        with self.lock:
            if program.has_failed():
                print(f"\n---- output of {program.name}\n{program.output}\n---- end of output of {program.name}\n")
            n_passed, n_failed, n_skipped = program.counts()
            text = f"{n_passed} passed" + f", {n_failed} failed" * (n_failed > 0) + f", {n_skipped} skipped" * (n_skipped > 0)
            verdict = f"FAILED (exit status {program.status})" if program.has_failed() else "ok"
            print(f"{program.secs:7.1f} s  {program.name}: {verdict}, {text}", flush=True)


def run(programs):
    """Runs all programs: BESIDE on one processor, COMPUTING with a low priority, and the others."""
    runner = Runner()
    threading.Thread(target=runner.print_progress, args=(programs,), daemon=True).start()
    processors = sorted(os.sched_getaffinity(0))
    beside = [program for program in programs if program.name in BESIDE]
    computing = [program for program in programs if program.name in COMPUTING]
    others = [program for program in programs if program not in beside + computing]
    threads = [
        threading.Thread(target=runner.run_all, args=(beside, processors[-1:], -NICE)),
        threading.Thread(target=runner.run_all, args=(computing, processors, NICE)),
    ]
    for thread in threads:
        thread.start()
    runner.run_all(others, processors)
    for thread in threads:
        thread.join()


def report(steps, build_secs, test_secs, programs):
    """The durations of all steps, programs and slowest tests, as Markdown."""
    lines = ["| step | seconds |", "|---|---:|"]
    lines += [f"| {name} | {secs:.0f} |" for name, secs in [*steps, ("build of the tests", build_secs), ("tests", test_secs)]]
    total_secs = sum(secs for _, secs in steps) + build_secs + test_secs
    lines += [f"| **total** | **{total_secs:.0f}** |", ""]
    lines += ["| test program | seconds | of a processor | passed | failed | skipped |", "|---|---:|---:|---:|---:|---:|"]
    for program in sorted(programs, key=lambda program: -program.secs):
        n_passed, n_failed, n_skipped = program.counts()
        secs = f"{program.secs:.1f} | {program.processor_secs:.1f}"
        lines.append(f"| {program.name} | {secs} | {n_passed} | {n_failed} | {n_skipped} |")
    tests = [(secs, program.name, test) for program in programs for test, _, secs in program.tests]
    lines += ["", f"| {N_SLOWEST} slowest tests | seconds |", "|---|---:|"]
    lines += [f"| {name}: `{test}` | {secs:.1f} |" for secs, name, test in sorted(tests, reverse=True)[:N_SLOWEST]]
    return "\n".join(lines)


def read_steps(path):
    """Names and seconds of earlier steps."""
    if path is None or not path.exists():
        return []
    rows = (line.rsplit("\t", 1) for line in path.read_text().splitlines())
    return [(name, float(secs)) for name, secs in rows]


def summarize(programs):
    """Prints skipped and failed tests, then the counts. Returns whether all tests passed."""
    skipped = collections.defaultdict(list)
    for program in programs:
        for test, reason in program.skipped.items():
            skipped[reason].append(f"{program.name}: {test}")
    for reason, tests in sorted(skipped.items()):
        print(f"\nskipped, because {reason}:")
        for test in tests:
            print(f"    {test}")
    failed = [program for program in programs if program.has_failed()]
    if failed:
        print("\nfailed:")
    for program in failed:
        names = [test for test, result, _ in program.tests if result == "FAILED"]
        for name in names or [f"exit status {program.status}"]:
            print(f"    {program.name}: {name}")
            for place, message in panics_in(program.output, name):
                print(f"        {place}: {message[:MAX_MESSAGE]}")
    n_passed, n_failed, n_skipped = (sum(counts) for counts in zip(*(program.counts() for program in programs)))
    n_failed += sum(program.count("FAILED") == 0 for program in failed)
    print(f"\n{n_passed} passed, {n_failed} failed, {n_skipped} skipped")
    return not failed


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=pathlib.Path)
    parser.add_argument("--report", type=pathlib.Path)
    parser.add_argument("--only", type=re.compile)
    parser.add_argument("--filter")
    parser.add_argument("--no-doc", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("cargo_arguments", nargs="*")
    arguments = parser.parse_args()
    since = time.monotonic()
    built = build(arguments.cargo_arguments)
    programs = quick(built) if arguments.quick else separated(built)
    build_secs = time.monotonic() - since
    if not arguments.no_doc:
        programs.append(doc_tests(arguments.cargo_arguments))
    if arguments.only:
        programs = [program for program in programs if arguments.only.search(program.name)]
    if arguments.filter:
        for program in programs:
            program.command.append(arguments.filter)
    if not programs:
        sys.exit("run-tests: no test program matches")
    since = time.monotonic()
    try:
        run(programs)
    except KeyboardInterrupt:
        for program in programs:
            program.stop()
        sys.exit(130)
    test_secs = time.monotonic() - since
    text = report(read_steps(arguments.steps), build_secs, test_secs, programs)
    print(f"\n{text}")
    if arguments.report:
        arguments.report.write_text(text + "\n")
    has_passed = summarize(programs)
    longest = sorted(programs, key=lambda program: -program.secs)[:N_LONGEST]
    print(f"build {build_secs:.0f} s, tests {test_secs:.0f} s; {', '.join(f'{of.name} {of.secs:.0f} s' for of in longest)}")
    sys.exit(0 if has_passed else 1)


if __name__ == "__main__":
    main()
