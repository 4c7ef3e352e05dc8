"""A parser for incomplete Tcl commands: the words before the cursor and the open brackets around it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field


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
