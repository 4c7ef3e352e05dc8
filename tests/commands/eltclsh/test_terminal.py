"""Sessions on a terminal: input, output and keys."""

from __future__ import annotations

from pathlib import Path

from rosafe import __version__
from rosafe.commands.eltclsh.line import decode, encode
from tests import harness
from tests.commands.eltclsh.conftest import environment
from tests.terminal import Terminal

ELTCLSH = str(harness.SCRIPTS / "eltclsh")
QUESTION = "*** Got signal SIGINT\n*** Choose 1: continue, 2: exit, 3: back to the prompt > "
PASTE = "\x1b[200~{}\x1b[201~\r"


def test_banner_prompt_results_and_errors(home: Path) -> None:
    with Terminal([ELTCLSH], environment(home)) as terminal:
        assert terminal.expect("eltclsh > ").startswith(f"eltclsh {__version__}, Tcl 8.6.")
        assert terminal.run("set x 3") == "3"
        assert terminal.run("nothing of this name") == 'invalid command name "nothing"'
        assert terminal.run("puts héllo") == "héllo"
        assert terminal.run("list") == ""
        assert terminal.run("list $tcl_interactive $argc [file tail $argv0] [info level]") == "1 0 eltclsh 0"
        assert terminal.run("return done; error not") == "done"
        assert terminal.run("!!") == "return done; error not\ndone"  # from the history of Tcl
        terminal.press("exit 3\r")
        assert terminal.end() == 3


def test_commands_of_several_lines(terminal: Terminal) -> None:
    terminal.press("proc f {} {\r", "\n: ")
    terminal.press("  return 5\r", "\n: ")
    terminal.run("}")
    assert terminal.run("f") == "5"
    terminal.press("\x1b[A\x1b[A")  # the arrow key recalls all its lines
    terminal.expect("return 5")
    terminal.press("\x05\r", "eltclsh > ")
    terminal.press(PASTE.format("set a 1\nset b [expr {\n1 + 1}]\nset c 3"))
    assert terminal.expect("3\neltclsh > ").endswith("1\n2\n3\neltclsh > ")


def test_prompts_of_the_user(terminal: Terminal) -> None:
    terminal.run("set el::prompt1 {robot> }", "robot> ")
    terminal.run("set n 6; proc count {} {return [incr ::n]>}; set el::prompt1 count", "7>")
    terminal.run("list", "8>")
    terminal.run("proc el::prompt2 {} {return {more: }}", "9>")
    terminal.press("list {\r", "more: ")
    terminal.run("}", "10>")
    terminal.run("set el::prompt1 {error bad}", "bad\neltclsh > ")


def test_events_are_served_while_the_prompt_waits(terminal: Terminal) -> None:
    terminal.run("set pipe [open {|sh -c {read x; echo got $x}} r+]; fconfigure $pipe -buffering line")
    terminal.run("fileevent $pipe readable {puts [gets $pipe]; close $pipe}")
    terminal.press("set half", "set half")
    terminal.press("\x15puts $pipe it\r", "got it")
    terminal.press("\r", "eltclsh > ")
    # A question interrupts the line that is being typed, which is continued afterwards.
    terminal.run("set pipe [open {|sh -c {read x; echo $x}} r+]; fconfigure $pipe -buffering line")
    terminal.run("fileevent $pipe readable {gets $pipe name; close $pipe; set answer [el::gets $name]}")
    terminal.run("after 300 {puts $pipe sure?}")
    terminal.press("set ha", "set ha")
    terminal.expect("\nsure?")
    terminal.press("of course\r", "eltclsh > set ha")
    terminal.press("lf 5\r", "5\neltclsh > ")
    assert terminal.run("list $answer $half") == "{of course} 5"
    terminal.press("after 1 {exit 6}\r")
    assert terminal.end() == 6


def test_the_history_is_saved_between_sessions(home: Path) -> None:
    entries = ["set x {a\n\tb}", "puts {\\ \u00e9 # \u4e2d}", "last"]
    assert decode(encode(entries)) == entries
    assert decode("plain\nlines\n") == ["plain", "lines"]
    (home / ".eltclhistory").write_text(encode([f"set old {n}" for n in range(900)]))
    with Terminal([ELTCLSH], environment(home)) as terminal:
        terminal.expect("eltclsh > ")
        assert terminal.run("el::history event 1") == "set old 101"
        assert terminal.run("el::history size") == "800"
        terminal.run("el::history add {set new 1}")
        assert terminal.run("el::history event") == "set new 1"
        terminal.run("el::history change {set new 2}")
        terminal.press("\x1b[A", "set new 2")
        terminal.press("\r", "2\neltclsh > ")
        terminal.press("\x04")
        assert terminal.end() == 0
    assert (home / ".eltclhistory").stat().st_mode & 0o777 == 0o600
    kept = decode((home / ".eltclhistory").read_text())
    assert len(kept) == 800
    assert kept[-1] == "set new 2"
    assert sorted(path.name for path in home.iterdir()) == [".eltclhistory"]
    with Terminal([ELTCLSH], environment(home)) as terminal:
        terminal.expect("eltclsh > ")
        terminal.run("el::history file /absent/file")
        assert terminal.run("el::history save") == "/absent/file: No such file or directory"
        assert terminal.run("set errorCode") == "POSIX 2 {No such file or directory}"
        terminal.run("el::history file /dev/null")
        assert terminal.run("el::history save") == "/dev/null: /dev/null is not a regular file"
        terminal.run("el::history file /absent/file")
        assert "the history is not saved" in terminal.press("exit\r", "/absent/file'")
        assert terminal.end() == 0


def test_ctrl_c_while_a_command_runs(terminal: Terminal) -> None:
    for busy in ("after 1", "catch {vwait forever}"):
        terminal.run("set n 0")
        terminal.press(f"while 1 {{if {{[incr n] == 1}} {{puts be[list gun]}}; {busy}}}\r", "begun\n")
        terminal.press("\x03", QUESTION)
        terminal.press("x1")  # continues
        terminal.expect("> 1\n")
        terminal.press("\x03", QUESTION)
        terminal.press("3", "eltclsh > ")
        assert int(terminal.run("set n")) > 0
    terminal.press("exec sh -c {echo begun >/dev/tty; exec sleep 60}\r", "begun\n")
    terminal.press("\x03", QUESTION)
    terminal.press("2")
    assert terminal.end() == 0


def test_ctrl_c_at_the_prompt(terminal: Terminal) -> None:
    terminal.press("set kept", "set kept")
    terminal.press("\x03", QUESTION)
    terminal.press("1", "eltclsh > set kept")
    terminal.press(" 7\r", "7\neltclsh > ")
    terminal.press("proc gone {} {\r", "\n: ")
    terminal.press("half", "half")
    terminal.press("\x03", QUESTION)
    terminal.press("\x03", "eltclsh > ")
    assert terminal.run("info commands gone") == ""
    terminal.press("el::gets {name? }\r", "\nname? ")
    terminal.press("\x03", QUESTION)
    assert terminal.press("3", "eltclsh > ") == "3\ninterrupted\neltclsh > "
    terminal.press("\x03", QUESTION)
    terminal.press("2")
    assert terminal.end() == 0


def test_signals_of_the_user(terminal: Terminal) -> None:
    assert terminal.run("signal INT") == "::el::interrupted"
    terminal.run("signal INT {puts mine}")
    terminal.press("\x03", "mine\n")
    terminal.run("signal USR1 {puts user; error bad}")
    terminal.press("exec kill -USR1 [pid]\r", "user\n")
    terminal.expect("bad\n")


def test_answers_for_the_procedures_of_the_original(terminal: Terminal) -> None:
    terminal.press("aska int number 4\r", "number [4]> ")
    assert "expecting integer but got x\n" in terminal.press("x\r", "number [4]> ")
    assert terminal.press("2 * 3\r", "eltclsh > ").splitlines()[-2] == "6"
    terminal.press("aska {red green} colour green\r", "colour [green]> ")
    terminal.press("r\t", "red ")
    assert "\nred\n" in terminal.press("\r", "eltclsh > ")
    terminal.press("el::getc\r", "getc\n")
    assert terminal.press("é", "eltclsh > ").endswith("é\neltclsh > ")
    terminal.press("el::gets {end? }\r", "\nend? ")
    assert "no input" in terminal.press("\x04", "eltclsh > ")


def test_tab_completes(terminal: Terminal, home: Path) -> None:
    (home / "a folder").mkdir()
    (home / "some.tcl").write_text("")
    terminal.run("namespace eval deep::inner {proc command {} {}}; set deep::value 1; array set robots {first 1}")
    terminal.run("oo::class create Robot {method walk {} {}}; Robot create r2; set handle r2")
    for typed, completed in (
        ("lappe\t", "lappend "),
        ("dee\tin\tco\t", "deep::inner::command "),
        ("::dee\tin\tco\t", "::deep::inner::command "),
        ("puts [string le\t", "puts [string length "),
        ("if 1 {lsor\t", "if 1 {lsort "),
        ("set tcl_pa\t", "set tcl_patchLevel "),
        ("puts $tcl_pa\t", "puts $tcl_patchLevel "),
        ("puts ${deep::va\t", "puts ${deep::value}"),
        ("puts $rob\tfi\t", "puts $robots(first)"),
        ("r2 wa\t", "r2 walk "),
        ("$handle wa\t", "$handle walk "),
        ("source ~/so\t", "source ~/some.tcl "),
        ("cd ~/a\t", "cd ~/a\\ folder/"),
        ("package req\tgeno\t", "package require genomix "),
        ("signal US\t", "signal USR"),
        ("flush std\te\t", "flush stderr "),
    ):
        terminal.press(typed, completed)
        terminal.press("\x15")
    shown = terminal.press("lre\t", "eltclsh > lre")
    assert "lrepeat" in shown and "lreplace" in shown and "lreverse" in shown
    terminal.press("\x15")
    terminal.run("set el::queryItems 2; lappend el::completionPatterns {^mine$ {p 1 {alpha beta}} {n ^alpha$ d}}; list")
    terminal.press("lre\t", "Display all 3 possibilities? (y or n)")
    terminal.press("n\x15mine al\t", "mine alpha ")
    terminal.press("\x15")
    terminal.run("lappend el::completionPatterns {^part$ {C , {first second}}}; list")  # after the last match
    terminal.press("part first,x,se\t", "part first,x,second ")


def test_the_terminal_is_restored(home: Path) -> None:
    with Terminal(["/bin/sh"], {**environment(home), "PS1": "sh$ "}) as terminal:
        terminal.expect("sh$ ")
        before = terminal.run("stty -a", "sh$ ")
        terminal.press(f"{ELTCLSH}\r", "eltclsh > ")
        terminal.run("exit 3", "sh$ ")
        assert terminal.run("echo $?", "sh$ ") == "3"
        assert terminal.run("stty -a", "sh$ ") == before
        terminal.press(f"{ELTCLSH}\r", "eltclsh > ")
        terminal.run("close stdin", "sh$ ")


def test_a_script_can_start_the_prompt(home: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.tcl"
    script.write_text("set mine 1\nputs $tcl_interactive\nproc f {} {interactive}\nf\nputs after\nexit 2\n")
    with Terminal([ELTCLSH, str(script)], environment(home)) as terminal:
        assert terminal.expect("eltclsh > ").startswith("0\n")
        assert terminal.run("list [incr mine] $tcl_interactive") == "2 1"
        terminal.press("\x04", "after\n")
        assert terminal.end() == 2
