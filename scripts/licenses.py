#!/usr/bin/env python3
"""Lists the licenses of everything from others that the program contains, in docs/reference/licenses.md.

usage: licenses.py              writes the list
       licenses.py --check      fails if the list is not up to date
       licenses.py --texts FILE writes the license texts of all crates, for packages of the program

The crates are those that Cargo.lock connects to the program without `dev-dependencies`, build scripts and procedural
macros, for Linux. Their manifests come from cargo's registry folder, so nothing is downloaded, and cargo is not needed.
"""

import os
import pathlib
import re
import sys
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
LIST = ROOT / "docs/reference/licenses.md"
BEGIN = "<!-- The rest is written by scripts/licenses.py. -->\n"
CARGO_HOME = pathlib.Path(os.environ.get("CARGO_HOME", pathlib.Path.home() / ".cargo"))
# What `cfg` conditions can ask about the systems for which the program is built.
SYSTEMS = [
    {"unix", 'target_os="linux"', 'target_family="unix"', 'target_env="gnu"', 'target_pointer_width="64"', 'target_endian="little"',
     f'target_arch="{architecture}"', 'panic="unwind"'}
    for architecture in ("x86_64", "aarch64")
]


def table(manifest):
    with open(manifest, "rb") as file:
        return tomllib.load(file)


def is_for_linux(condition):
    """Whether dependencies with this condition are built for one of the systems."""
    if not condition.startswith("cfg("):
        return condition in ("x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu")
    return any(holds(condition, system) for system in SYSTEMS)


def holds(condition, system):
    """Evaluates a condition such as `cfg(all(unix, not(target_os = "macos")))`."""
    tokens = re.findall(r'\w+\s*=\s*"[^"]*"|\w+|[()]', condition)

    def value():
        word = tokens.pop(0)
        if not tokens or tokens[0] != "(":
            return word.replace(" ", "") in system
        tokens.pop(0)
        values = []
        while tokens[0] != ")":
            values.append(value())
        tokens.pop(0)
        return {"all": all, "any": any, "cfg": all, "not": lambda values: not values[0]}[word](values)

    return value()


def names_in(part, is_counted=lambda value: True):
    """Names of the packages in a table of dependencies."""
    return {
        value.get("package", name) if isinstance(value, dict) else name
        for name, value in part.get("dependencies", {}).items()
        if is_counted(value)
    }


def linked_names(manifest):
    """Names of the packages on which the program depends through this package."""
    targets = manifest.get("target", {})
    for_linux = [names_in(part) for condition, part in targets.items() if is_for_linux(condition)]
    for_others = [names_in(part) for condition, part in targets.items() if not is_for_linux(condition)]
    # Cargo.lock does not tell why it has an optional dependency. If another system needs it, that is the reason.
    optional = names_in(manifest, lambda value: isinstance(value, dict) and value.get("optional", False))
    only_others = (optional & set().union(*for_others)) - set().union(*for_linux)
    return (names_in(manifest) - only_others).union(*for_linux)


class Packages:
    """The packages of Cargo.lock."""

    def __init__(self):
        self.locked = {}
        for package in table(ROOT / "Cargo.lock")["package"]:
            self.locked.setdefault(package["name"], []).append(package)
        workspace = table(ROOT / "Cargo.toml")
        self.renamed = {
            name: value["package"]
            for name, value in workspace["workspace"].get("dependencies", {}).items()
            if isinstance(value, dict) and "package" in value
        }
        folders = [ROOT, *(ROOT / member for member in workspace["workspace"]["members"])]
        self.own = {table(folder / "Cargo.toml")["package"]["name"]: folder for folder in folders}

    def folder(self, package):
        if "source" not in package:
            return self.own[package["name"]]
        name = f"{package['name']}-{package['version']}"
        folders = list((CARGO_HOME / "registry/src").glob(f"*/{name}"))
        if not folders:
            sys.exit(f"licenses: the source of {name} is missing in {CARGO_HOME}/registry/src; to get it, run: cargo fetch --locked")
        return folders[0]

    def dependencies(self, package, manifest):
        names = {self.renamed.get(name, name) if "source" not in package else name for name in linked_names(manifest)}
        for entry in package.get("dependencies", []):
            name, *version = entry.split(" ")
            if name in names:
                candidates = self.locked[name]
                yield next(other for other in candidates if not version or other["version"] == version[0])

    def linked(self):
        """All packages from others that the program contains, with their manifests, by name."""
        found = {}
        waiting = [self.locked["fieldrig"][0]]
        seen = set()
        while waiting:
            package = waiting.pop()
            key = (package["name"], package["version"])
            if key in seen:
                continue
            seen.add(key)
            folder = self.folder(package)
            manifest = table(folder / "Cargo.toml")
            if manifest.get("lib", {}).get("proc-macro", manifest.get("lib", {}).get("proc_macro")):
                continue
            if "source" in package:
                found.setdefault(package["name"], []).append((folder, manifest["package"]))
            waiting += self.dependencies(package, manifest)
        return dict(sorted(found.items()))


def license_of(folder, package):
    if "license" not in package:
        return f"file {package['license-file']}"
    # Older manifests separate alternatives by a slash. Their order has no meaning.
    alternatives = re.split(r"\s*/\s*|\s+OR\s+", package["license"])
    return package["license"] if "(" in package["license"] else " OR ".join(sorted(alternatives))


def described(packages):
    """The table of crates by license."""
    by_license = {}
    for name, versions in packages.items():
        for license_name in sorted({license_of(folder, package) for folder, package in versions}):
            by_license.setdefault(license_name, []).append(name)
    lines = ["| license | crates |", "|---|---|"]
    for license_name, names in sorted(by_license.items(), key=lambda entry: (-len(entry[1]), entry[0])):
        lines.append(f"| {license_name} | {', '.join(names)} |")
    return "\n".join(lines) + "\n"


def write_texts(path, packages):
    """Writes the license texts in the sources of all crates."""
    texts = []
    for name, versions in packages.items():
        for folder, package in versions:
            texts.append(f"{'=' * 80}\n{name} {package['version']}: {license_of(folder, package)}\n")
            authors = ", ".join(package.get("authors", []))
            if authors:
                texts.append(f"{authors}\n")
            for file in sorted(folder.iterdir()):
                if re.match(r"(?i)(licen[cs]e|copying|notice|copyright|unlicense)", file.name) and file.is_file():
                    texts.append(f"\n{'-' * 20} {file.name}\n{file.read_text(errors='replace')}\n")
    pathlib.Path(path).write_text("".join(texts))


def main():
    packages = Packages().linked()
    arguments = sys.argv[1:]
    if len(arguments) == 2 and arguments[0] == "--texts":
        write_texts(arguments[1], packages)
        return
    if arguments not in ([], ["--check"]):
        sys.exit(__doc__)
    text = LIST.read_text()
    head, marker, _ = text.partition(BEGIN)
    if not marker:
        sys.exit(f"licenses: {LIST} lacks the line {BEGIN.strip()}")
    expected = head + BEGIN + "\n" + described(packages)
    if not arguments:
        LIST.write_text(expected)
    elif text != expected:
        sys.exit("licenses: docs/reference/licenses.md is not up to date; run: scripts/licenses.py")


main()
