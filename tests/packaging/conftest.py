"""A compiler that makes the same library once for all who build the kernels in a copy of the checkout."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.packaging.clone import ENVIRONMENT

# gcc, but what it has made once of the same sources it does not make again.
GCC = """#!/usr/bin/python3
import hashlib, os, pathlib, shutil, subprocess, sys
output = pathlib.Path(sys.argv[sys.argv.index("-o") + 1])
sha = hashlib.sha256(repr([word for word in sys.argv[1:] if word.startswith("-")]).encode())
for source in sorted(pathlib.Path(next(word for word in sys.argv if word.endswith(".c"))).parent.glob("*.[ch]")):
    sha.update(source.read_bytes())
kept = pathlib.Path(__file__).with_name(sha.hexdigest())
if not kept.exists():
    subprocess.run(["/usr/bin/gcc", *sys.argv[1:]], check=True)
    new = kept.with_suffix(f".{os.getpid()}")
    shutil.copy(output, new)
    new.rename(kept)
shutil.copy(kept, output)
"""


@pytest.fixture(scope="session", autouse=True)
def _gcc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The first compiler on the PATH of all that is run here, but where a test says otherwise.

    The processes of one run of the tests share what it has made.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    program = folder / "gcc"
    new = folder / f"gcc.{os.getpid()}"
    new.write_text(GCC)
    new.chmod(0o755)
    new.rename(program)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVIRONMENT, "PATH", f"{folder}:{ENVIRONMENT['PATH']}")
        yield
