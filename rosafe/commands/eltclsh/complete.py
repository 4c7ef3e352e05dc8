"""Completion with TAB: commands, parameters of components, subcommands and methods, variables, files; el::parse."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from rosafe.commands.eltclsh.interpreter import Interpreter

_SPACE = " "  # after a complete word


class Completer:
    """Finds completions in a Tcl interpreter. A completion is the new word with its trailing space or bracket."""

    def __init__(self, interpreter: Interpreter) -> None:
        self._tcl = interpreter

    def complete(self, before: str, word: str) -> list[str]:
        """Return the completions of `word`; `before` is the text before it."""
        variable = re.search(r"\$(\{?)(?:([\w:]+)\()?$", before)
        if variable:
            brace, array = variable.groups()
            return self._array_elements(array, word) if array else self._variables(word, "}" if brace else _SPACE)
        stack, _ = scan(before)
        current = stack[-1]
        if len(stack) > 1 and current.opener == "{":
            inside = self._dict_members(stack[-2].words, current, word)
            if inside is not None:
                return inside
        words = [self._value(w) for w in current.words]
        for candidates in (self._by_patterns(words, word), self._by_command(words, word)):
            if candidates is not None:
                return candidates
        return self._commands(word) if not words else sorted({*self._variables(word, _SPACE), *self._files(word)})

    def _value(self, word: Word) -> str:
        """Return the word, or its value if it is a variable."""
        if word.text.startswith("$"):
            return self._tcl.variable(word.text[1:].strip("{}")) or word.text
        return word.bare

    # --- commands ---

    def _commands(self, word: str) -> list[str]:
        names = [name + _SPACE for name in self._tcl.elements("info", "commands", _glob(word))]
        return sorted({*_matching(word, names), *self._namespaces(word)})

    def _namespaces(self, word: str) -> list[str]:
        parent = word.rpartition("::")[0]
        return _matching(word, (f"{name}::" for name in self._tcl.elements("namespace", "children", f"{parent}::")))

    def _by_command(self, words: list[str], word: str) -> list[str] | None:
        """Return the arguments that the command accepts, for components, ensembles and objects; None for others."""
        if not words:
            return None
        kind, parameters, switches, values = self._about(words[0])
        if kind:
            if word.startswith("-"):
                return _with_prefix(word, switches)
            given = [w for w in words[1:] if not w.startswith("-")]
            if values and not given:
                return _with_prefix(word, values)
            if len(given) != bool(values):
                return None
            # Parameters are in braces, which are added to the first word.
            return _with_prefix("{" + word, [f"{{{name}" for name in parameters])
        if len(words) > 1:
            return None
        if self._tcl.elements("namespace", "ensemble", "exists", words[0]) == ["1"]:
            ensemble = ("namespace", "ensemble", "configure", words[0])
            return _with_prefix(
                word, self._tcl.elements(*ensemble, "-map")[::2] or self._tcl.elements(*ensemble, "-subcommands")
            )
        if self._tcl.elements("info", "object", "isa", "object", words[0]) == ["1"]:
            return _with_prefix(word, self._tcl.elements("info", "object", "methods", words[0], "-all"))
        return None

    def _about(self, command: str) -> tuple[str, list[str], list[str], list[str]]:
        """Return kind, parameters, switches and first values of a component's command; empty for other commands."""
        about = self._tcl.elements("::genomix::about", command)
        if len(about) != 4:
            return "", [], [], []
        kind, *lists = about
        parameters, switches, values = map(self._tcl.split, lists)
        return kind, parameters, switches, values

    def _dict_members(self, words: list[Word], inside: Context, word: str) -> list[str] | None:
        """Return parameters inside the braces of a component's command; None for other braces."""
        if not words:
            return None
        kind, parameters, _, values = self._about(self._value(words[0]))
        given = [element.bare for element in inside.elements]
        if not kind or sum(not w.text.startswith("-") for w in words[1:]) > bool(values):
            return None
        return [] if len(given) % 2 else _with_prefix(word, (name for name in parameters if name not in given[::2]))

    # --- variables, files ---

    def _variables(self, word: str, tail: str) -> list[str]:
        found = self._tcl.elements("uplevel", "#0", ("info", "vars", _glob(word)))  # type: ignore[arg-type]
        arrays = {
            name for name in found if self._tcl.elements("array", "exists", f"::{name.removeprefix('::')}") == ["1"]
        }
        names = [name + ("(" if name in arrays else tail) for name in found]
        return sorted({*_matching(word, names), *self._namespaces(word)} if word else {*_matching(word, names)})

    def _array_elements(self, array: str, word: str) -> list[str]:
        return _with_prefix(word, self._tcl.elements("array", "names", f"::{array.removeprefix('::')}"), ")")

    def _files(self, word: str, directories_only: bool = False) -> list[str]:
        folder, _, name = word.rpartition("/")
        base = Path(os.path.expanduser(f"{folder}/" if "/" in word else "."))
        try:
            entries = sorted(base.iterdir())
        except OSError:  # missing folder or missing permission
            return []
        found = []
        for entry in entries:
            hidden = entry.name.startswith(".") and not name
            if entry.name.startswith(name) and not hidden and (entry.is_dir() or not directories_only):
                escaped = re.sub(r'([\s\\$"{}\[\];])', r"\\\1", entry.name)
                found.append(word[: len(word) - len(name)] + escaped + ("/" if entry.is_dir() else _SPACE))
        return found

    # --- el::completionPatterns ---

    def _by_patterns(self, words: list[str], word: str) -> list[str] | None:
        """Return the completions of the first rule for the command, or None.

        The variable is a list of rules ``{command {kind pattern action} ...}``. A pattern of kind `p` matches the
        number of the word, `c` and `C` the word itself (`C` completes the part after the match), `n` the previous word,
        and `N` the word before the previous one.
        """
        for rule in self._tcl.elements("set", "::el::completionPatterns"):
            command, *parts = self._tcl.split(rule)
            if not re.search(command, words[0] if words else word):
                continue
            for part in parts:
                kind, pattern, action = (*self._tcl.split(part), "", "", "")[:3]
                skipped = self._skipped(kind, pattern, words, word)
                if skipped is not None:
                    return [word[:skipped] + match for match in self._perform(action, word[skipped:])]
            return None
        return None

    @staticmethod
    def _skipped(kind: str, pattern: str, words: list[str], word: str) -> int | None:
        """Return the number of characters before the completed part, or None if the pattern does not match."""
        if kind == "p":
            return 0 if re.fullmatch(pattern, str(len(words))) else None
        if kind in ("n", "N"):
            back = 1 if kind == "n" else 2
            return 0 if len(words) > back - 1 and re.search(pattern, words[-back]) else None
        matches = list(re.finditer(pattern, word))
        if not matches:
            return None
        return matches[-1].end() if kind == "C" else 0

    def _perform(self, action: str, word: str) -> list[str]:
        match action:
            case "v" | "A":
                return self._variables(word, _SPACE)
            case "c" | "C" | "N":
                return self._commands(word)
            case "p":
                return _with_prefix(word, self._tcl.elements("info", "procs", _glob(word)))
            case "n":
                return self._namespaces(word)
            case "f" | "F":
                return self._files(word)
            case "d":
                return self._files(word, directories_only=True)
            case "k":
                # Tcl searches for packages only when an unknown one is requested.
                self._tcl.elements("eval", "{*}[package unknown] {} 0-")
                return _with_prefix(word, self._tcl.elements("package", "names"))
            case "i":
                return _with_prefix(word, self._tcl.elements("interp", "slaves"))
        if action.startswith("["):
            return _with_prefix(word, self._tcl.elements("uplevel", "#0", action[1:-1]))
        return _with_prefix(word, self._tcl.split(action))


def _with_prefix(word: str, names: Iterable[str], tail: str = _SPACE) -> list[str]:
    return sorted({name + tail for name in names if name.startswith(word)})


def _matching(word: str, names: Iterable[str]) -> list[str]:
    """Return the names that start with the word, with a leading ``::`` if the word has one."""
    absolute = word.startswith("::")
    candidates = (("::" if absolute else "") + name.removeprefix("::") for name in names)
    return [name for name in candidates if name.startswith(word)]


def _glob(word: str) -> str:
    return re.sub(r"([*?\[\]\\])", r"\\\1", word) + "*"


# --- the words before the cursor, in an incomplete command ----------------------------------------------------------


@dataclass(frozen=True)
class Word:
    """A word as it was typed, including braces and quotes, and its position."""

    text: str
    start: int

    @property
    def end(self) -> int:
        """The index after the word."""
        return self.start + len(self.text)

    @property
    def bare(self) -> str:
        """The word without the braces or quotes around it."""
        if len(self.text) > 1 and (self.text[0], self.text[-1]) in (("{", "}"), ('"', '"')):
            return self.text[1:-1]
        return self.text


_COMMENT, _END = r"(?P<comment>#[^\n]*)|", r"(?P<end>[\n;])|"
_WORD = r"(?P<escape>\\(?!\n).?)|(?P<blank>[ \t\r]|\\\n)|(?P<character>.)"
_AT_COMMAND, _IN_COMMAND, _IN_QUOTES = (
    re.compile(pattern, re.DOTALL) for pattern in (_COMMENT + _END + _WORD, _END + _WORD, _WORD)
)
_CLOSERS = {"]": "[", "}": "{", '"': '"'}


@dataclass
class Context:
    """The content of an open bracket, brace or quote, or of the whole text.

    Attributes
    ----------
    opener : str
        The bracket, brace or quote; empty for the whole text.
    commands : list of list of Word
        The complete words of each command; the cursor is in the last command.
    word_start : int or None
        Where the current word starts.
    """

    opener: str
    commands: list[list[Word]] = field(default_factory=lambda: [[]])
    word_start: int | None = None

    @property
    def words(self) -> list[Word]:
        """The complete words of the current command."""
        return self.commands[-1]

    @property
    def elements(self) -> list[Word]:
        """All complete words, for braces that contain a list and not a script."""
        return [word for command in self.commands for word in command]

    @property
    def tokens(self) -> re.Pattern[str]:
        """The pattern of the next token; comments are recognized at the start of a command only."""
        if self.opener == '"':
            return _IN_QUOTES
        return _IN_COMMAND if self.words or self.word_start is not None else _AT_COMMAND

    def end_word(self, text: str, end: int) -> None:
        """Add the current word, if there is one, to the command."""
        if self.word_start is not None:
            self.words.append(Word(text[self.word_start : end], self.word_start))
            self.word_start = None


def scan(text: str) -> tuple[list[Context], Word]:
    """Return the contexts that are open at the end of `text`, innermost last, and the (possibly empty) last word."""
    stack = [Context("")]
    at = 0
    while (token := stack[-1].tokens.match(text, at)) is not None:
        context, kind, content = stack[-1], token.lastgroup, token[0]
        if kind in ("blank", "end"):
            context.end_word(text, at)
            if kind == "end" and context.words:
                context.commands.append([])
        elif _CLOSERS.get(content) == context.opener:
            context.end_word(text, at)
            stack.pop()
        elif kind != "comment":
            opens = content == "[" or (content in ("{", '"') and context.word_start is None)
            if context.word_start is None:
                context.word_start = at
            if opens:
                stack.append(Context(content))
        at = token.end()
    start = stack[-1].word_start
    start = len(text) if start is None else start
    return stack, Word(text[start:], start)


def parse(text: str) -> tuple[object, ...]:
    """Implement el::parse: text, start, end and words (type, text, start, end, tokens) of the innermost command."""
    stack, last = scan(text)
    words = [*stack[-1].words, *([last] if last.text else [])]
    items = []
    for word in words:
        plain = not any(mark in word.text for mark in "$[\\") or word.text.startswith("{")
        token = "text" if plain else "variable" if word.text.startswith("$") else "command"
        kind = "simple-word" if plain else "word"
        items.append((kind, word.bare, word.start, word.end, ((token, word.bare, word.start, word.end, ()),)))
    start = words[0].start if words else last.start
    end = words[-1].end if words else last.start
    return text[start:end], start, end, tuple(items)
