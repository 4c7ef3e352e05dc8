"""Where the cursor is in a Tcl command that is not finished: which words are before it, and inside which brackets."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Word:
    """A word as it was typed, with braces and quotes around it, and where it lies."""

    text: str
    start: int

    @property
    def end(self) -> int:
        """The index behind the word."""
        return self.start + len(self.text)

    @property
    def bare(self) -> str:
        """The word without the braces or quotes around it."""
        if len(self.text) > 1 and (self.text[0], self.text[-1]) in (("{", "}"), ('"', '"')):
            return self.text[1:-1]
        return self.text


@dataclass
class Context:
    """What is open at one level: the whole text, or a bracket, brace or quote that nothing has closed yet.

    `opener` is empty for the whole text; `commands` are the commands in it as lists of complete words, the last one
    being the one that the cursor is in.
    """

    opener: str
    start: int
    commands: list[list[Word]] = field(default_factory=lambda: [[]])

    @property
    def words(self) -> list[Word]:
        """The complete words of the command that the cursor is in."""
        return self.commands[-1]

    @property
    def elements(self) -> list[Word]:
        """All complete words, for braces that hold a list and not a script."""
        return [word for command in self.commands for word in command]


_CLOSERS = {"]": "[", "}": "{", '"': '"'}


def scan(text: str) -> tuple[list[Context], Word]:
    """The levels that are open at the end of `text`, innermost last, and the (perhaps empty) word that ends there."""
    stack = [Context("", 0)]
    starts: list[int | None] = [None]  # for each level, where its current word began
    at = 0
    while at < len(text):
        character = text[at]
        context = stack[-1]
        word_begins = starts[-1] is None
        if character == "\\" and text[at + 1 : at + 2] != "\n":
            starts[-1] = at if word_begins else starts[-1]
            at += 2
            continue
        if character in " \t\r\\" or (character in "\n;" and context.opener != '"'):
            _end_word(context, starts, text, at)
            if character in "\n;" and context.words:
                context.commands.append([])
            at += 2 if character == "\\" else 1  # a backslash here is one before the end of a line
            continue
        if character == "#" and word_begins and not context.words and context.opener != '"':
            at = text.find("\n", at) if "\n" in text[at:] else len(text)
            continue
        if _CLOSERS.get(character) == context.opener and len(stack) > 1:
            _end_word(context, starts, text, at)
            stack.pop()
            starts.pop()
        elif character == "[" or (word_begins and character in '{"'):
            starts[-1] = at if word_begins else starts[-1]
            stack.append(Context(character, at))
            starts.append(None)
        elif word_begins:
            starts[-1] = at
        at += 1
    begun = starts[-1]
    start = len(text) if begun is None else begun
    return stack, Word(text[start:], start)


def _end_word(context: Context, starts: list[int | None], text: str, at: int) -> None:
    begun = starts[-1]
    if begun is not None:
        context.words.append(Word(text[begun:at], begun))
        starts[-1] = None


def parse(text: str) -> tuple[object, ...]:
    """el::parse: (text, start, end, words) of the innermost command, words being (type, text, start, end, tokens)."""
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
