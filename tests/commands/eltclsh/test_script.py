"""eltclsh without a terminal: scripts run as with tclsh, including arguments and exit codes."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path

import pytest

from rosafe import __version__
from tests import harness
from tests.commands.eltclsh.conftest import Run, environment
from tests.harness import PATIENCE

# Both shells run each of these; output, errors and exit code must be equal.
SCRIPTS = {
    "arguments": "puts [list $argv $argc $argv0 $tcl_interactive [info script] [info level] [info frame]]",
    "levels": 'proc f {} {uplevel 1 {set x 1}; return [info level]}\nputs "[f] $x [info exists x]"',
    "error": "proc p {} {error oops}\np",
    "error in an event": "after 1 {error late; set done 1}\nafter 10 {after idle {set done 1}}\nvwait done\nputs on",
    "thrown": "throw {MY CODE} {what happened}",
    "unknown command": "puts before\nnoSuchCommand x\nputs after",
    "unbalanced": "puts {never closed",
    "break": "break",
    "return": "puts a\nreturn\nputs b",
    "exit": "puts a\nexit 7\nputs b",
    "exit is final": "catch {exit 5}\nputs still",
    "exit in an event": "after 1 {exit 4}\nvwait forever",
    "own exit": "rename exit leave\nproc exit {args} {puts own; leave 9}\nputs x",
    "bad exits": "puts [catch {exit a} m]$m\nputs [catch {exit 1 2} m]$m",
    "unflushed file": "set f [open out.txt w]\nputs $f kept",
    "unflushed pipe": "set f [open |cat w]\nputs $f piped",
    "children": 'puts [exec sh -c "echo $argv"]\nputs [catch {exec yes | head -n 1} m][string length $m]',
    "itself": "puts [exec [info nameofexecutable] << {puts [expr {6 * 7}]}]",
    "coroutines": "coroutine c apply {{} {yield 1; yield 2}}\nputs [c]",
    "own names": "proc shift {x} {return mine}\nproc signal {} {return s}\nputs [shift 1][signal]",
    "closed output": "close stdout\nputs stderr on",
    "input": "while {[gets stdin line] >= 0} {puts <$line>}",
    "commands": "foreach c {history unknown package exit} {puts [llength [info commands $c]]}",
    "texts": 'puts "\\u00e9\\u4e2d [string length \\u00e9\\u4e2d]"',
    "requires": "puts [package require Tcl]\nputs [catch {package require nothing} m]$m",
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_runs_as_with_tclsh(run: Run, tmp_path: Path, name: str) -> None:
    script = tmp_path / "script.tcl"
    script.write_text(SCRIPTS[name] + "\n", "utf-8")
    results = []
    for shell in ("tclsh", "eltclsh"):
        done = run(str(script), "-a", "b c", shell=shell, stdin="one\ntwo")
        kept = tmp_path / "out.txt"
        results.append((done.stdout, done.stderr, done.returncode, kept.read_text() if kept.exists() else ""))
        kept.unlink(missing_ok=True)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    "typed",
    [
        "puts [expr 1+1]\nset x 3\n",
        "proc f {} {\n return 5\n}\nputs [f]\nnothing\nputs on\n",
        "gets stdin line\nread by gets\nputs $line\n",
        "puts $tcl_interactive$argv$argc\nexit 3\n",
        "puts {never closed\n",
        "puts last",
        "",
    ],
)
def test_piped_commands_run_as_with_tclsh(run: Run, typed: str) -> None:
    expected, done = (run(shell=shell, stdin=typed) for shell in ("tclsh", "eltclsh"))
    assert (done.stdout, done.stderr, done.returncode) == (expected.stdout, expected.stderr, expected.returncode)


def test_a_missing_script_and_an_encoding(run: Run, tmp_path: Path) -> None:
    done = run("missing.tcl")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith('couldn\'t read file "missing.tcl": no such file or directory')
    (tmp_path / "latin.tcl").write_bytes(b"puts [string length \xe9\xe9]$argv")
    assert run("-encoding", "iso8859-1", "latin.tcl", "x").stdout == "2x\n"


def test_scripts_that_are_programs(run: Run, tmp_path: Path, home: Path) -> None:
    """The headers that published scripts have."""
    env = {**environment(home), "PATH": f"{harness.SCRIPTS}:/usr/bin:/bin"}
    for header in ('#!/bin/sh\n# -*-Tcl-*- \\\nexec eltclsh "$0" ${1+"$@"}\n', "#!/usr/bin/env eltclsh\n"):
        script = tmp_path / "program"
        script.write_text(header + "puts [list $argv [file tail $argv0]]\n")
        script.chmod(0o755)
        done = subprocess.run([script, "a b"], env=env, capture_output=True, text=True, check=True, timeout=PATIENCE)
        assert done.stdout == "{{a b}} program\n"


def test_packages_are_found_without_any_set_up(run: Run, tmp_path: Path) -> None:
    assert run(stdin="puts [package require genomix][package require eltclsh]\n").stdout == "1.81.20\n"
    for name in ("mine", "other"):
        folder = tmp_path / f"{name} lib"
        folder.mkdir()
        (folder / "pkgIndex.tcl").write_text(f"package ifneeded {name} 1 {{package provide {name} 1; puts {name}!}}\n")
    lines = "puts [package require other]\nputs $argv:$argc\n"
    paths = {"ELTCLLIBPATH": f"{{{tmp_path}/mine lib}}", "ELTCL_LIBRARY": str(tmp_path / "other lib")}
    done = run("-package", "mine", "-package", "none", "-x", stdin=lines, **paths)
    assert done.stdout == "mine!\nother!\n1\n-x:1\n"
    assert done.stderr == "can't find package none\ncannot load none\n"
    (tmp_path / "script.tcl").write_text("puts $argv")
    assert run("-package", "mine", "script.tcl", "a", ELTCLLIBPATH=f"{{{tmp_path}/mine lib}}").stdout == "mine!\na\n"
    assert "ELTCLLIBPATH: unmatched open brace" in run("script.tcl", ELTCLLIBPATH="{").stderr


def test_the_rc_file_runs_before_scripts(run: Run, home: Path, tmp_path: Path) -> None:
    (home / ".eltclshrc").write_text("set greeting hello\n")
    (tmp_path / "script.tcl").write_text("puts $greeting")
    assert run("script.tcl").stdout == "hello\n"
    (home / ".eltclshrc").write_text("set greeting good\nerror bad\n")
    done = run("script.tcl")
    assert done.stdout == "good\n"
    assert "bad\n    while executing" in done.stderr


def test_el_procedures_without_a_terminal(run: Run) -> None:
    script = """
        proc report {script} {puts [catch $script result],$result,[lindex $::errorCode 0]}
        set l {1 2 3}; puts [shift l]-$l
        wrappedputs {a text of some words} 9
        puts <[el::gets "name? "]>
the answer
        puts <[el::getc]>
x
        puts [aska int {how many} 3]
.
        puts [aska {red green} colour green blue]
red
        puts [mapscan {{string name nobody} {opt bool really 1} {double size 2.5}} {Bob}]

        puts [mapscan {{int a 1} {int b 2}} {7 ..}]
        report {mapscan {{int}} {}}
        report {el::history event 5}
        report {el::history size many}
        report {signal NOPE x}
        report {signal KILL {puts no}}
        report {el::gets}
        puts [lrange [signal names] 0 1]
        puts [signal TERM -ignore][signal TERM][signal TERM -default][signal TERM]
        report {el::gets ""}
    """
    done = run(stdin=script.replace("\n        ", "\n").rstrip(" "))
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "1-2 3",
        "a text of",
        "some",
        "words",
        "name? <the answer>",
        "<x>",
        "how many [3]> 3",
        "expecting enum {red green} but got blue",
        "colour [green]> red",
        "size [2.5]> Bob 1 2.5",
        "7 2",
        '1,bad format int: should be "{ ?opt? type prompt default }",NONE',
        '1,no event "5" in the history,ELTCLSH',
        '1,expected integer but got "many",ELTCLSH',
        '1,unknown signal "NOPE": see signal names,ELTCLSH',
        "1,Invalid argument,POSIX",
        '1,wrong # args: should be "el::gets prompt",TCL',
        "HUP INT",
        "-default-ignore-ignore-default",
        "1,no input,ELTCLSH",
    ]


def test_interactive_in_a_script_reads_commands_from_stdin(run: Run, tmp_path: Path) -> None:
    (tmp_path / "script.tcl").write_text("proc f {} {set hidden 1; interactive}\nset seen 1\nf\nputs after\n")
    done = run("script.tcl", stdin="puts [info exists seen][info exists hidden]\n")
    assert done.stdout == "10\nafter\n"


def test_signals_in_a_busy_script(run: Run, tmp_path: Path) -> None:
    (tmp_path / "script.tcl").write_text(
        "set got {}\nsignal USR1 {lappend got [info level]; error reported}\nexec kill -USR1 [pid]\n"
        "while {![llength $got]} {}\nputs got:$got\nafter 1 {after idle {set end 1}}\nvwait end\n"
    )
    done = run("script.tcl")
    assert done.stdout == "got:0\n"
    assert done.stderr.startswith("reported\n    while executing")


def test_ctrl_c_ends_a_script(home: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.tcl"
    script.write_text("puts ready\nflush stdout\nwhile 1 {}\n")
    with harness.Process([str(harness.SCRIPTS / "eltclsh"), str(script)], environment(home)) as process:
        harness.wait_for(lambda: "ready" in process.out)
        assert process.stop(signal.SIGINT) == -signal.SIGINT


def test_help_and_version(run: Run) -> None:
    assert run("--help").stdout.startswith("usage: eltclsh [-package NAME]")
    assert run("--version", shell="elwish").stdout == f"elwish {__version__}\n"
