"""What was measured, as tables in Markdown."""

from __future__ import annotations

from typing import Any


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
        lines += ["## Other configurations", "", "Cost per unit of work is against the default's.", ""]
        for kind, found in measured["configurations"].items():
            rows = [[text, f"{cost['ms']:.2f}", f"{cost['per unit']:.2f}"] for text, cost in found.items()]
            lines += _table([kind, "ms", "per unit of work"], rows)
        first, memory = measured["first block (s)"], measured["memory (MB)"]
        lines += [
            "## What else",
            "",
            f"* a new process loads in {first['load']:.2f} s; from the request to the first block it takes"
            f" {first['from request to block']:.3f} s",
            f"* between blocks the default chain holds {memory['state']:.1f} MB; a stage takes up to"
            f" {memory['scratch']:.1f} MB more while it works, besides its output",
            f"* silence after sound costs {measured['silence over sound']:.2f} times what sound costs",
            "",
        ]
    return "\n".join(lines)


def _times(times: dict[str, float]) -> list[str]:
    return [f"{times['yardstick']:.2f}", f"{times['rosafe']:.2f}", f"{times['ratio']:.1f}"]
