"""What was measured, as tables in Markdown."""

from __future__ import annotations

from typing import Any

import configurations


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    return [
        "| " + " | ".join(head) + " |",
        "|" + "|".join(["---"] + ["--:"] * (len(head) - 1)) + "|",
        *("| " + " | ".join(row) + " |" for row in rows),
        "",
    ]


def as_markdown(measured: dict[str, Any]) -> str:
    """The results of chain.py."""
    lines = ["# The chain, timed", "", "By benchmarks/chain.py: ms of computing per second of sound, medians.", ""]
    lines += [f"* {name}: {value}" for name, value in measured["machine"].items()] + [""]
    for block, stages in measured["one core"].items():
        lines += [f"## One core, blocks of {block}", ""]
        rows = [[kind, *_times(times)] for kind, times in stages.items()]
        lines += _table(["stage", "yardstick", "rosafe", "times as fast"], rows)
    if "two cores" in measured:
        lines += ["## Two cores (the threaded tree; wall clock)", ""]
        rows = [[f"blocks of {block}", *_times(times)] for block, times in measured["two cores"].items()]
        lines += _table(["", "yardstick, one core", "rosafe", "times as fast"], rows)
        lines += _configurations(measured["configurations"])
        lines += _small_blocks(measured["small blocks (us)"])
        first, memory = measured["first block (s)"], measured["memory (MB)"]
        lines += [
            "## What else",
            "",
            f"* a new process loads in {first['load']:.2f} s; from the request to the first block it takes"
            f" {first['from request to block']:.3f} s",
            f"* between blocks the default chain holds {memory['state']:.1f} MB; a stage takes up to"
            f" {memory['scratch']:.1f} MB more while it works, besides its output",
            "",
            "What silence after sound costs, for what sound costs (the whole chain):",
            "",
        ]
        silence = measured["silence over sound"]
        rows = [[name, f"{ratio:.2f}"] for name, ratio in silence["kernels"].items()]
        rows += [[f"{name}, the twins", f"{ratio:.2f}"] for name, ratio in silence["twins"].items()]
        lines += _table(["chain", "silence / sound"], rows)
    return "\n".join(lines)


def _times(times: dict[str, float]) -> list[str]:
    return [f"{times['yardstick']:.2f}", f"{times['rosafe']:.2f}", f"{times['ratio']:.1f}"]


MARK = "<!-- What follows is written by benchmarks/chain.py. -->\n"


def _configurations(measured: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    lines = ["## Other configurations", "", "Cost per unit of work is for one of the default's.", ""]
    for kind, found in measured.items():
        rows = [[text, f"{cost['ms']:.2f}", f"{cost['per unit']:.2f}"] for text, cost in found.items()]
        lines += [f"{kind}: a unit of work is {configurations.UNITS[kind]}.", ""]
        lines += _table([kind, "ms", "per unit of work"], rows)
    worst = max(cost["per unit"] for found in measured.values() for cost in found.values())
    return [*lines, f"The dearest unit of work costs {worst:.2f} times what the default's costs.", ""]


def _small_blocks(measured: dict[str, dict[str, float]]) -> list[str]:
    """A block costs a fixed part, about that of one sample, and one in proportion to its samples."""
    sizes = list(next(iter(measured.values())))
    rows = [[kind, *(f"{cost:.0f}" for cost in found.values())] for kind, found in measured.items()]
    lines = ["## Small blocks", "", "Microseconds that one block of so many samples takes, 31 channels.", ""]
    return lines + _table(["stage", *sizes], rows)
