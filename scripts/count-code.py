#!/usr/bin/env python3
"""Counts what makes the Rust code longer or harder to read, per crate and for the largest types.

usage: count-code.py [FOLDER]

Tests are left out. Long closures are bound by `let` and have more than three lines. Methods are those of inherent
implementations, without accessors for tests.
"""

import collections
import pathlib
import re
import subprocess
import sys

MAX_TYPES = 8


def sources(root):
    """The paths of Rust files in the repository, relative to `root`, without tests."""
    listed = subprocess.run(["git", "ls-files", "*.rs"], cwd=root, capture_output=True, text=True, check=True)
    for path in listed.stdout.split():
        is_test = path.startswith("tests/") or "/tests/" in path or path.endswith(("tests.rs", "testing.rs"))
        if not is_test and (root / path).exists():
            yield path


def crate_of(root, path):
    """The folder of the crate that a file belongs to."""
    folder = pathlib.PurePath(path).parent
    while folder.parts and not (root / folder / "Cargo.toml").exists():
        folder = folder.parent
    return str(folder) if folder.parts else "."


def without_unit_tests(text):
    return text.split("#[cfg(test)]\nmod tests")[0]


def count_lines(text, counts):
    for line in text.split("\n"):
        stripped = line.strip()
        counts["lines"] += 1
        if stripped.startswith("//"):
            is_inside = line.startswith("    ") and not stripped.startswith(("///", "//!"))
            counts["inner comments"] += is_inside
        elif stripped:
            counts["code"] += 1
            counts["characters"] += len(stripped)


def count_patterns(text, counts):
    counts["match on bool"] += len(re.findall(r"\btrue => ", text))
    counts["paths of modules"] += text.count("#[path")
    closure = r"\n( *)let (?:mut )?\w+ = (?:move )?\|[^|\n]*\|(?: -> [^{\n]+)? \{\n"
    for found in re.finditer(closure, text):
        end = text.find("\n" + found.group(1) + "};", found.end())
        if end > 0 and text[found.start() + 1 : end].count("\n") > 2:
            counts["long closures"] += 1


def count_methods(crate, text, methods):
    implementation = r"(?m)^((?:#\[cfg\(test\)\]\n)?)impl(?:<[^{\n]*?>)? (\w+)[^{\n]*\{\n(.*?)^\}"
    for found in re.finditer(implementation, text, re.S):
        is_test, name, body = found.groups()
        if is_test or re.search(r"\bfor\b", found.group(0).split("{")[0]):
            continue
        functions = re.findall(r"(?m)^    ((?:#\[cfg\(test\)\]\n    )?)(?:pub(?:\([^)]*\))? )?(?:const )?(?:async )?fn ", body)
        methods[crate, name] += sum(not is_test for is_test in functions)


def main():
    root = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    crates = collections.defaultdict(collections.Counter)
    methods = collections.Counter()
    for path in sources(root):
        crate = crate_of(root, path)
        text = without_unit_tests((root / path).read_text())
        count_lines(text, crates[crate])
        count_patterns(text, crates[crate])
        count_methods(crate, text, methods)
    total = sum(crates.values(), collections.Counter())
    print("lines per crate:", ", ".join(f"{crate} {counts['lines']}" for crate, counts in sorted(crates.items())))
    print(f"lines: {total['lines']}, code: {total['code']}, paths of modules: {total['paths of modules']}")
    print(f"characters per line of code: {total['characters'] / total['code']:.1f}")
    for name in ("long closures", "inner comments", "match on bool"):
        print(f"{name} per 1000 lines of code: {1000 * total[name] / total['code']:.2f}")
    largest = methods.most_common(MAX_TYPES)
    print("methods:", ", ".join(f"{name} ({crate}) {n}" for (crate, name), n in largest))


if __name__ == "__main__":
    main()
