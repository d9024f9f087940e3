"""A report of sections, each with its text, tables and figures."""

from collections.abc import Iterator
from dataclasses import dataclass

from .table import Block


@dataclass(frozen=True, slots=True)
class Section:
    """A heading, its paragraphs, then tables and figures, then the sections below it."""

    title: str
    text: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = ()
    subsections: "tuple[Section, ...]" = ()

    def walk(self, level: int) -> "Iterator[tuple[int, Section]]":
        """Yield this section and those below it in the order of reading, each with its level."""
        yield level, self
        for one in self.subsections:
            yield from one.walk(level + 1)


@dataclass(frozen=True, slots=True)
class Document:
    """A whole report; the facts (versions, seeds, settings) stand at its end."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = ()

    def walk(self) -> Iterator[tuple[int, Section]]:
        """Yield every section in the order of reading, with the level of its heading."""
        for section in self.sections:
            yield from section.walk(2)

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Every table and figure, in the order of reading."""
        return tuple(block for _, section in self.walk() for block in section.blocks)
