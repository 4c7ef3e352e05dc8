"""The settings of the C library's allocator are accepted, and a process releases unused memory."""

from __future__ import annotations

from tests.harness import PYTHON, ROOT, Graph, proc

# Allocates memory of all sizes in many threads, frees almost all, and prints the resident MiB.
SPREAD = """
import random, threading
from rosafe.component import malloc_tuning
malloc_tuning.limit_arenas()
def resident():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1]) // 1024
kept, before = [], resident()
def work(seed):
    chance = random.Random(seed)
    pieces = [bytes(chance.randrange(1000, 300_000)) for _ in range(300)]
    kept.extend(pieces[::100])
threads = [threading.Thread(target=work, args=(seed,)) for seed in range(12)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
malloc_tuning.trim()
print(resident() - before)
"""


def test_freed_memory_is_returned_to_the_system(graph: Graph) -> None:
    proc()
    done = graph.run(PYTHON, "-c", SPREAD, PYTHONPATH=str(ROOT))
    assert int(done.stdout) < 60, "of some 500 MiB"
