"""Gather the files that Python and a virtual environment need to run: ``minimal_root.py ROOT VENV``.

The service's image is made of these alone. A distribution's base brings 80 MB of package manager, shell, Perl and
tools, none of which the service uses; without them the image is smaller, with less in it to attack or to patch.

Taken are the interpreter, its standard library without what only developers use, every shared library that one of their
binaries or of the environment's is linked with, root certificates, and the accounts. Of Debian packages that files were
taken from, the licence and an entry in ``/var/lib/dpkg/status.d`` come along, where vulnerability scanners look.
"""

import compileall
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path

DEVELOPERS = {
    "test",
    "tests",
    "idlelib",
    "tkinter",
    "turtledemo",
    "lib2to3",
    "ensurepip",
    "pydoc_data",
    "site-packages",
}
"""Folders of the standard library that a service has no use for, and third parties' packages."""

LOADED_BY_NAME = ("libgcc_s.so.1",)
"""Libraries that nothing is linked with: glibc loads this one to end a thread."""

OTHER_FILES = (
    "/etc/passwd",
    "/etc/group",
    "/etc/nsswitch.conf",
    "/etc/os-release",
    "/etc/ld.so.conf",
    "/etc/ssl/certs/ca-certificates.crt",
)


def main() -> None:
    root, venv = Path(sys.argv[1]), Path(sys.argv[2])
    make_folders(root)
    library = Path(sysconfig.get_path("stdlib"))
    interpreter = Path(sys.executable).resolve()
    files = {*library_files(library), interpreter, *map(Path, OTHER_FILES), *Path("/etc/ld.so.conf.d").glob("*.conf")}
    binaries = [interpreter, *library.rglob("*.so*"), *venv.rglob("*.so*")]
    files |= linked_libraries(binaries)
    for link in python_links(venv):
        copy_link(root, link)
    for file in sorted(files):
        copy_file(root, file)
    # Images of Python come without compiled modules, and the service's root is read-only: each start would compile.
    compileall.compile_dir(root / real_folder(library) / library.name, stripdir=str(root), quiet=1)
    # Libraries beside the system's own, in /usr/local/lib where images of Python have theirs, are found by this alone.
    subprocess.run(["ldconfig", "-r", str(root)], check=True)
    if shutil.which("dpkg-query"):
        copy_package_entries(root, files)


def make_folders(root: Path) -> None:
    """Make the folders that a container needs, and the links of a merged /usr."""
    for folder in ("usr/bin", "usr/lib", "usr/lib64", "etc", "proc", "sys", "dev", "run", "var/lib", "tables"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for name in ("bin", "lib", "lib64"):
        (root / name).symlink_to(f"usr/{name}")
    (root / "tmp").mkdir()
    (root / "tmp").chmod(0o1777)
    tables = Path("/tables").stat()
    os.chown(root / "tables", tables.st_uid, tables.st_gid)


def library_files(library: Path) -> Iterator[Path]:
    """Files of the standard library."""
    for folder, folders, names in os.walk(library):
        folders[:] = [name for name in folders if name not in DEVELOPERS and not name.startswith("config-")]
        yield from (Path(folder) / name for name in names)


def linked_libraries(binaries: Iterable[Path]) -> set[Path]:
    """Shared libraries of the system that the dynamic linker finds for some binaries, the linker itself included."""
    libraries = set()
    for binary in binaries:
        done = subprocess.run(["ldd", str(binary)], capture_output=True, text=True, check=False)
        libraries |= {Path(path) for path in re.findall(r"(?:=> |^\t)(/\S+) \(0x", done.stdout, re.MULTILINE)}
        missing = re.findall(r"^\t(\S+) => not found", done.stdout, re.MULTILINE)
        if missing:
            print(f"{binary} is linked with {', '.join(missing)}, not found", file=sys.stderr)
    found = {path for path in libraries if not path.is_relative_to("/opt")}
    folders = {path.parent for path in found}
    return found | {folder / name for folder in folders for name in LOADED_BY_NAME if (folder / name).exists()}


def python_links(venv: Path) -> Iterator[Path]:
    """Links that lead from the environment's interpreter to the real one, outside the environment."""
    link = venv / "bin" / "python3"
    while link.is_symlink():
        if not link.is_relative_to(venv):
            yield link
        link = link.parent / link.readlink()


def copy_link(root: Path, link: Path) -> None:
    """Copy a symbolic link as one."""
    target = root / real_folder(link) / link.name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(link.readlink())


def copy_file(root: Path, file: Path) -> None:
    """Copy a file under its name, and under the name that links lead to only its content."""
    if not file.exists():
        return
    target = root / real_folder(file) / file.name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(file, target)


def real_folder(file: Path) -> Path:
    """Return the folder of a file with links followed, relative to the root."""
    return file.parent.resolve().relative_to("/")


def copy_package_entries(root: Path, files: Iterable[Path]) -> None:
    """Copy the licences and the database entries of the Debian packages that files are of."""
    paths = {str(path) for file in files for path in (file, file.resolve())}
    # Packages of a merged /usr may list their files under either name.
    paths |= {path.removeprefix("/usr") for path in paths}
    done = subprocess.run(["dpkg-query", "--search", *sorted(paths)], capture_output=True, text=True, check=False)
    packages = {name.strip() for line in done.stdout.splitlines() for name in line.rpartition(": ")[0].split(",")}
    status = root / "var/lib/dpkg/status.d"
    status.mkdir(parents=True)
    for package in sorted(packages):
        name = package.partition(":")[0]
        entry = subprocess.run(["dpkg-query", "--status", package], capture_output=True, text=True, check=True)
        (status / name).write_text(entry.stdout, encoding="utf-8")
        copy_file(root, Path("/usr/share/doc") / name / "copyright")


if __name__ == "__main__":
    main()
