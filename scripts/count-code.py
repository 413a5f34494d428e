#!/usr/bin/env python3
"""Counts what makes the Rust code longer or harder to read, per crate and for the largest types.

Tests are left out. Long closures are bound by `let` and have more than three lines. Methods are those of inherent
implementations, without accessors for tests.
"""

import argparse
import collections
import itertools
import pathlib
import re
import subprocess

MAX_TYPES = 12
COMMAND_LINE = "src/"


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
    return re.split(r"#\[cfg\(test\)\]\n(?:pub\([a-z]+\) )?mod tests \{", text)[0]


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


class Definitions:
    """The files that define types, because types of several files of a crate may have the same name."""

    def __init__(self):
        self.files = collections.defaultdict(list)

    def add(self, crate, path, text):
        for name in re.findall(r"(?m)^(?:pub(?:\([^)]*\))? )?(?:struct|enum|union) (\w+)", text):
            self.files[crate, name].append(path)

    def nearest(self, crate, name, path):
        """The file that defines the type which an implementation in the file `path` belongs to."""
        parts = pathlib.PurePath(path).parts

        def n_common(defined):
            pairs = zip(parts, pathlib.PurePath(defined).parts)
            return sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))

        return max(self.files[crate, name], key=n_common, default=path)


def count_methods(crate, path, text, definitions, methods):
    implementation = r"(?m)^((?:#\[cfg\(test\)\]\n)?)impl(?:<[^{\n]*?>)? (\w+)[^{\n]*\{\n(.*?)^\}"
    for found in re.finditer(implementation, text, re.S):
        is_test, name, body = found.groups()
        if is_test or re.search(r"\bfor\b", found.group(0).split("{")[0]):
            continue
        functions = re.findall(r"(?m)^    ((?:#\[cfg\(test\)\]\n    )?)(?:pub(?:\([^)]*\))? )?(?:const )?(?:async )?fn ", body)
        defined = definitions.nearest(crate, name, path)
        methods[crate, defined, name] += sum(not is_test for is_test in functions)


def arguments():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=pathlib.Path, default=".", metavar="FOLDER", help="the repository (default: this folder)"
    )
    return parser.parse_args()


def main():
    root = arguments().folder
    crates = collections.defaultdict(collections.Counter)
    methods = collections.Counter()
    n_command_line = 0
    definitions = Definitions()
    texts = {path: without_unit_tests((root / path).read_text()) for path in sources(root)}
    for path, text in texts.items():
        definitions.add(crate_of(root, path), path, text)
    for path, text in texts.items():
        crate = crate_of(root, path)
        count_lines(text, crates[crate])
        count_patterns(text, crates[crate])
        count_methods(crate, path, text, definitions, methods)
        if path.startswith(COMMAND_LINE):
            n_command_line += text.count("\n") + 1
    total = sum(crates.values(), collections.Counter())
    print("lines per crate:", ", ".join(f"{crate} {counts['lines']}" for crate, counts in sorted(crates.items())))
    print(f"lines of the command line: {n_command_line}")
    print(f"lines: {total['lines']}, code: {total['code']}, paths of modules: {total['paths of modules']}")
    print(f"characters per line of code: {total['characters'] / total['code']:.1f}")
    for name in ("long closures", "inner comments", "match on bool"):
        print(f"{name} per 1000 lines of code: {1000 * total[name] / total['code']:.2f}")
    largest = methods.most_common(MAX_TYPES)
    print("methods:", ", ".join(f"{name} ({crate}) {n}" for (crate, _, name), n in largest))


if __name__ == "__main__":
    main()
