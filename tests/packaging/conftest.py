"""Compilers that cache their results, for all tests that build the kernels in a copy of the checkout."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.packaging.clone import CLANG, ENVIRONMENT

# Runs gcc or clang, and caches the result for each compiler and set of options, sources and headers, without their
# comments. Only a user who may write in the folder of this program adds results.
COMPILER = r"""#!/usr/bin/python3 -IS
import hashlib, os, pathlib, re, shutil, subprocess, sys
here = pathlib.Path(__file__)
real = "/usr/bin/" + here.name.removeprefix("cached-")
output = pathlib.Path(sys.argv[sys.argv.index("-o") + 1])
options = [word for word in sys.argv[1:] if word.startswith("-")]
sha = hashlib.sha256(repr([os.path.realpath(real), os.stat(real).st_mtime_ns, *options]).encode())
folders = {pathlib.Path(word).parent for word in sys.argv[1:] if word.endswith(".c")}
for source in sorted(path for folder in folders for path in folder.glob("*.[ch]")):
    code = re.sub(rb"//[^\n]*|/\*.*?\*/|\s+", b" ", source.read_bytes(), flags=re.DOTALL)
    sha.update(source.name.encode() + code.strip())
cached = here.with_name(sha.hexdigest())
if cached.exists():
    shutil.copy(cached, output)
    cached.touch()
else:
    subprocess.run([real, *sys.argv[1:]], check=True)
    if os.access(here.parent, os.W_OK):
        new = cached.with_suffix(f".{os.getpid()}")
        shutil.copy(output, new)
        new.rename(cached)
"""
MAX_CACHED = 40  # results: about eight for each version of the sources


@pytest.fixture(scope="session", autouse=True)
def _compilers() -> Iterator[None]:
    """Put the caching gcc first on the PATH of all commands in these tests; the caching clang is `CLANG`.

    The cache is beside the kernels of this checkout, and remains for the next run of the tests.
    """
    folder = CLANG.parent
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    results = sorted(folder.glob("?" * 64), key=lambda path: -path.stat().st_mtime)
    for old in results[MAX_CACHED:]:
        old.unlink(missing_ok=True)
    for program in (folder / "gcc", CLANG):
        new = folder / f"{program.name}.{os.getpid()}"
        new.write_text(COMPILER)
        new.chmod(0o755)
        new.rename(program)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVIRONMENT, "PATH", f"{folder}:{ENVIRONMENT['PATH']}")
        yield
