"""`rosafe process --dask`: the same numbers from the workers of a scheduler, also if one of them is killed."""

from __future__ import annotations

import importlib.util
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.commands.command import refused, rosafe, start
from tests.commands.test_corpus import OPTIONS, assert_results, corpus, failed
from tests.harness import proc, wait_for

if not Path("/proc/meminfo").exists():
    pytest.skip("Dask needs /proc, which is not mounted here", allow_module_level=True)
if importlib.util.find_spec("distributed") is None:  # its import takes seconds, in each process that runs tests
    pytest.skip("Dask is not installed", allow_module_level=True)


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Two worker processes with one thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        local_directory=str(tmp_path_factory.mktemp("dask")),
        silence_logs=50,
    ) as cluster:
        yield cluster


@pytest.mark.exploration
def test_a_worker_is_killed_during_the_run(tmp_path: Path, cluster: Any) -> None:
    sounds = corpus(tmp_path / "corpus", 40)
    (tmp_path / "corpus" / "bad.wav").write_bytes(b"")
    out = tmp_path / "out"
    with cluster.get_client() as client:
        workers = list(client.run(os.getpid).values())
    assert len(workers) == 2
    arguments = ("process", "corpus", "-o", "out", *OPTIONS, "--dask", cluster.scheduler_address)
    with start(*arguments, cwd=tmp_path) as command:
        wait_for(lambda: len(list(out.rglob("*.npz"))) >= 5, what=lambda: str(command))
        os.kill(workers[0], signal.SIGKILL)
        assert command.wait(120) == 1, command
    assert "41 files: 40 done, 1 failed; " in command.err and "distributed" not in command.err, command
    assert list(failed(out)) == ["corpus/bad.wav"]
    assert_results(out, sounds)
    assert not proc(workers[0]).exists() and proc(workers[1]).exists()


def test_local_workers(tmp_path: Path) -> None:
    """Local workers end with the command, and resume an earlier run.

    They import nothing from the corpus: it is data, even if it is the working directory and contains Python files.
    """
    sounds = corpus(tmp_path, 3)
    assert rosafe("process", "s0.wav", "-o", "out/", *OPTIONS, cwd=tmp_path).returncode == 0
    for name in ("struct", "random", "numpy", "rosafe", "sitecustomize"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write({name!r})\n")
    done = rosafe("process", ".", "-o", "out", *OPTIONS, "--dask", "local", "--resume", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, ""), done
    assert done.stderr.splitlines()[-1].startswith("3 files: 2 done, 1 already complete; "), done
    assert_results(tmp_path / "out", sounds)
    assert not (tmp_path / "ran").exists()


def test_no_scheduler(tmp_path: Path) -> None:
    corpus(tmp_path / "corpus", 1)
    done = rosafe("process", "corpus", "-o", "out", *OPTIONS, "--dask", "tcp://127.0.0.1:1", cwd=tmp_path)
    refused(done, "--dask tcp://127.0.0.1:1: no Dask scheduler answers")
    assert not (tmp_path / "out").exists()


@pytest.mark.exploration
@pytest.mark.parametrize("restarts", [True, False], ids=["restarted by Dask", "not restarted by Dask"])
def test_workers_that_die_at_their_start_end_the_run(tmp_path: Path, restarts: bool) -> None:
    """The parameter is False for later versions of Dask, which do not restart workers."""
    corpus(tmp_path / "corpus", 2)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(
        "import os, sys\n"
        "if 'spawn_main' in ' '.join(sys.orig_argv):\n"
        f"    open({str(tmp_path / 'starts')!r}, 'a').write('x')\n"
        "    os._exit(3)\n"
        f"if not {restarts}:\n"
        "    import distributed\n"
        "    async def stay_dead(nanny, exitcode): pass\n"
        "    distributed.Nanny._on_worker_exit = stay_dead\n"
    )
    arguments = ("process", "corpus", "-o", "out", *OPTIONS, "--dask", "local", "--jobs", "1")
    done = rosafe(*arguments, cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))
    refused(done, "--dask local: a worker process ended 3 times at its start", "exit code 3")
    assert (tmp_path / "starts").read_text() == "xxx"
