"""Equations as MathML, converted while the pages are built, so that a page needs no script and no network."""

import re

from docutils.nodes import Element, SkipNode
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import SphinxError
from sphinx.writers.html5 import HTML5Translator

# MathML scales a fence with its content, which TeX does by hand in `\big[ ... \Big\rangle`.
SIZED = re.compile(r"\\[bB]ig\s*(\\[a-z]+|\\[{}]|[\[\]()])")
OPENING = ("[", "(", r"\{", r"\langle", r"\lceil", r"\lfloor")


def mathml(latex: str, display: str) -> str:
    """Return the MathML element of an equation; an unknown command raises an error."""
    fenced = SIZED.sub(lambda m: (r"\left" if m[1] in OPENING else r"\right") + m[1], latex)
    made = convert(fenced.replace(r"\arg", r"\operatorname{arg}"), display=display)
    if "\\" in made:
        raise SphinxError(f"equation not converted: {latex!r} gave {made!r}")
    return made


def visit_inline(translator: HTML5Translator, node: Element) -> None:
    """Write an equation in running text."""
    translator.body.append(mathml(node.astext(), "inline"))
    raise SkipNode


def visit_block(translator: HTML5Translator, node: Element) -> None:
    """Write a displayed equation with its number, if it has one."""
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(f'<div class="math">{mathml(node.astext(), "block")}{number}</div>\n')
    raise SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
