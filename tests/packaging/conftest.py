"""A compiler that caches its results, for all tests that build the kernels in a copy of the checkout."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.harness import folder_of_run
from tests.packaging.clone import ENVIRONMENT

# Runs gcc, and caches the result for each set of options, sources and headers, without their comments.
GCC = r"""#!/usr/bin/python3 -IS
import hashlib, os, pathlib, re, shutil, subprocess, sys
output = pathlib.Path(sys.argv[sys.argv.index("-o") + 1])
sha = hashlib.sha256(repr([word for word in sys.argv[1:] if word.startswith("-")]).encode())
folders = {pathlib.Path(word).parent for word in sys.argv[1:] if word.endswith(".c")}
for source in sorted(path for folder in folders for path in folder.glob("*.[ch]")):
    code = re.sub(rb"//[^\n]*|/\*.*?\*/|\s+", b" ", source.read_bytes(), flags=re.DOTALL)
    sha.update(source.name.encode() + code.strip())
cached = pathlib.Path(__file__).with_name(sha.hexdigest())
if not cached.exists():
    subprocess.run(["/usr/bin/gcc", *sys.argv[1:]], check=True)
    new = cached.with_suffix(f".{os.getpid()}")
    shutil.copy(output, new)
    new.rename(cached)
shutil.copy(cached, output)
"""


@pytest.fixture(scope="session", autouse=True)
def _gcc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Put the caching compiler first on the PATH of all commands in these tests.

    The processes of one run of the tests share its cache.
    """
    folder = folder_of_run(tmp_path_factory)
    program = folder / "gcc"
    new = folder / f"gcc.{os.getpid()}"
    new.write_text(GCC)
    new.chmod(0o755)
    new.rename(program)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVIRONMENT, "PATH", f"{folder}:{ENVIRONMENT['PATH']}")
        yield
