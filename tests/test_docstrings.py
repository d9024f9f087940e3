"""Every public function says what goes in, what comes out, what is raised, and shows itself at work.

The sources are read, not imported, so that nothing escapes by being optional. Doctests themselves are run by
the suite (`--doctest-modules` over the package).
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Whose examples and shapes are part of what was promised; elsewhere a summary and what is raised.
FULL = ("frontend", "abduction")
# Beside these: functions that say what goes in and what comes out.
SIGNED = ("worldstate/checks.py", "worldstate/values.py", "worldstate/filter.py", "worldstate/state/")
PARTS = (*FULL, "adapters", "worldstate")
ARRAYS = r"ArrayLike|NDArray|Numbers|FloatArray|ComplexArray|Matrix"
# "(n, 2) float", "shape (n,)", "float or (bins,) float", "any shape", "same shape as ...".
SHAPES = r"\([^()]*,[^()]*\)|\(\.\.\.\)|shape|any number|broadcast|[Aa]s for|array_like of float|scalar"
# An equation is written as one and relates two sides; a source is a year, the paper, or says what it is.
MATHS = r"\.\. math::.*(?:\n(?: .*)?)*|:math:`[^`]*`|``[^`]*``"
RELATION = r"=|<|>|\\(?:ge|le|approx|propto|leftarrow)\b"
LABELS = r"\b[Ee]q\. \((?:looming|crbtau|crbtheta|lik|post)\)|\((?:cor:endfire|prop:recover)\)"
PAPER = rf"(?:{LABELS}|\b[Ss]ection [IVX]+) of the paper"
SOURCE = rf"\b(?:19|20)\d\d\b|{PAPER}|\b[Ff]rom the definition\b|\b[Dd]erived here: \w"
# What computes no quantity, and what it does instead.
WITHOUT_EQUATION = {
    "frontend/array.py:roof_array_56": "constant",
    "frontend/channel_health.py:ArrayHealth.unknown": "container",
    "frontend/channel_health.py:ArrayHealth.with_fault": "look-up",
    "frontend/channel_health.py:faults_where": "container",
    "frontend/ego_noise.py:spanned": "indices",
    "frontend/gaps.py:GapFinder.push": "delegates",
    "frontend/gcc.py:all_pairs": "indices",
    "frontend/harmonic_cancellation.py:HarmonicCanceller.follow": "setter",
    "frontend/hops.py:HopCutter.cut": "container",
    "frontend/listener.py:Listener.push": "delegates",
    "frontend/masking.py:ChannelMask.all_of": "container",
    "frontend/music.py:checked_covariance": "validation",
    "frontend/place_check.py:PlaceCheck.faults": "look-up",
    "frontend/presence.py:Presence.push": "container",
    "frontend/spectra.py:finite_complex": "validation",
    "frontend/stream.py:FrontEnd.follow_engine": "setter",
    "frontend/stream.py:FrontEnd.learn_ego_noise": "setter",
    "frontend/stream.py:FrontEnd.process": "delegates",
    "frontend/threads.py:one_blas_thread": "threads",
    "abduction/any_signature.py:signature_from_dict": "look-up",
    "abduction/classifier_signature.py:FittedClassifier.predict_proba": "interface",
    "abduction/cueing.py:CueingPolicies.for_alpha": "look-up",
    "abduction/cueing.py:CueingPolicy.rule": "container",
    "abduction/descriptors.py:car": "constant",
    "abduction/descriptors.py:motorcycle": "constant",
    "abduction/ensemble.py:EnsembleModel.at_site": "container",
    "abduction/ensemble_training.py:SiteEnsembleClassifier.predict_proba": "delegates",
    "abduction/pairwise.py:class_pairs": "indices",
    "abduction/risk_map.py:risk_map_from_dict": "look-up",
    "abduction/schema.py:check_schema": "validation",
    "abduction/schema.py:read_number": "validation",
    "abduction/schema.py:read_numbers": "validation",
    "abduction/schema.py:read_rows": "validation",
    "abduction/schema.py:schema_stamp": "constant",
    "abduction/signature.py:evidence_of": "container",
    "abduction/signature_training.py:Classifier.fit": "interface",
    "abduction/signature_training.py:Classifier.predict_proba": "interface",
    "abduction/signature_training.py:PublishedClassifier.predict_proba": "delegates",
    "abduction/signature_training.py:checked_labels": "validation",
    "abduction/site.py:SiteReference.from_row": "container",
    "abduction/site_estimate.py:SiteEstimate.start": "container",
}
# Neither do these, wherever they are.
SERIALISED = (".to_dict", ".from_dict")
PLAIN_BASES = {"Protocol", "Enum", "StrEnum", "Exception", "ValueError", "NamedTuple"}


@dataclass(frozen=True)
class Public:
    """One public function, method or class with its sections."""

    where: str
    node: ast.FunctionDef | ast.ClassDef
    owner: ast.ClassDef | None

    @property
    def text(self) -> str:
        return ast.get_docstring(self.node) or ""

    @property
    def sections(self) -> dict[str, str]:
        """Headings of numpydoc with what stands below them; the text before them below nothing."""
        parts = re.split(r"^(\w[\w ]*)\n-{3,}$", self.text, flags=re.MULTILINE)
        return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))

    @property
    def is_property(self) -> bool:
        decorators = {ast.unparse(decorator) for decorator in getattr(self.node, "decorator_list", [])}
        return "property" in decorators

    @property
    def arguments(self) -> list[str]:
        """Names that a caller passes; of a class those of its fields, or of its constructor."""
        if isinstance(self.node, ast.FunctionDef):
            a = self.node.args
            every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            return [one.arg for one in every if one.arg not in ("self", "cls")]
        for inner in self.node.body:
            if isinstance(inner, ast.FunctionDef) and inner.name == "__init__":
                return Public(self.where, inner, self.node).arguments
        fields = [inner for inner in self.node.body if isinstance(inner, ast.AnnAssign)]
        return [f.target.id for f in fields if isinstance(f.target, ast.Name) and f.target.id[0] != "_"]


def modules() -> Iterator[tuple[Path, str]]:
    for part in PARTS:
        for path in sorted((ROOT / part).rglob("*.py")):
            inside = path.relative_to(ROOT).parts
            linked = part == "worldstate" and inside[1] in ("frontend", "abduction", "adapters")
            if not linked and inside[:2] != ("worldstate", "cli") and not path.name.startswith("_"):
                yield path, part


def public(parts: tuple[str, ...] = PARTS) -> Iterator[Public]:
    for path, part in modules():
        if part not in parts:
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name.startswith("_"):
                continue
            where = f"{path.relative_to(ROOT)}:{node.name}"
            yield Public(where, node, None)
            for inner in node.body if isinstance(node, ast.ClassDef) else ():
                if isinstance(inner, ast.FunctionDef) and not inner.name.startswith("_"):
                    yield Public(f"{where}.{inner.name}", inner, node)


def functions(parts: tuple[str, ...] = PARTS) -> list[Public]:
    """Functions and methods, without properties and overloads."""
    found = [one for one in public(parts) if isinstance(one.node, ast.FunctionDef) and not one.is_property]
    return [one for one in found if not any("overload" in ast.unparse(d) for d in one.node.decorator_list)]


def signed() -> list[Public]:
    """Functions and methods of `FULL`, functions of `SIGNED`."""
    more = [one for one in functions(("worldstate",)) if one.where.startswith(SIGNED) and one.owner is None]
    return functions(FULL) + more


def classes(parts: tuple[str, ...] = PARTS) -> list[Public]:
    found = [one for one in public(parts) if isinstance(one.node, ast.ClassDef)]
    return [one for one in found if not PLAIN_BASES & {ast.unparse(base) for base in one.node.bases}]


def test_nothing_is_overlooked() -> None:
    """The walk itself."""
    found = {one.where for one in public()}
    assert len(found) > 800
    expected = {
        "frontend/stream.py:FrontEnd.process",
        "abduction/posterior.py:abduce",
        "adapters/listen.py:listen",
        "worldstate/filter.py:WorldFilter.update",
    }
    assert expected <= found


def test_everything_public_is_described() -> None:
    assert [one.where for one in public() if not one.text and not _is_overload(one)] == []


def test_every_argument_is_named() -> None:
    missing = [
        f"{one.where}({name})"
        for one in [*signed(), *classes(FULL)]
        for name in one.arguments
        if not re.search(rf"\b{name}\b", one.sections.get("Parameters", ""))
    ]
    assert missing == []


def test_every_array_says_its_shape() -> None:
    """Of whatever is annotated as an array."""
    missing = []
    for one in signed():
        a = one.node.args
        for argument in [*a.posonlyargs, *a.args, *a.kwonlyargs]:
            kind = ast.unparse(argument.annotation) if argument.annotation else ""
            said = _entry(one.sections.get("Parameters", ""), argument.arg)
            if re.search(ARRAYS, kind) and not re.search(SHAPES, said):
                missing.append(f"{one.where}({argument.arg}): {said[:60]!r}")
    assert missing == []


def test_whatever_comes_back_is_described() -> None:
    """By a section; of a method that begins with "Return", by that sentence."""
    missing = []
    for one in signed():
        returns = ast.unparse(one.node.returns) if one.node.returns else "None"
        told = {"Returns", "Yields"} & set(one.sections)
        told_at_once = one.owner is not None and re.match(r"(Return|Whether)\b", one.text)
        if returns not in ("None", "Never") and not told and not told_at_once:
            missing.append(one.where)
    assert missing == []


@pytest.mark.parametrize("part", PARTS)
def test_what_is_raised_is_listed(part: str) -> None:
    missing = [
        one.where
        for one in functions((part,))
        if any(isinstance(n, ast.Raise) and n.exc for n in _own(one.node)) and "Raises" not in one.sections
    ]
    assert missing == []


def test_functions_and_classes_show_themselves_at_work() -> None:
    every = [one for one in functions(FULL) if one.owner is None] + classes(FULL)
    assert [one.where for one in every if ">>>" not in one.sections.get("Examples", "")] == []


def test_everything_computed_has_an_equation() -> None:
    """In the function's own docstring: whoever asks for help on it does not see the module's head."""
    assert [name for name, one in _computing().items() if not _equations(one)] == []


def test_everything_computed_has_a_source() -> None:
    missing = [
        name
        for name, one in _computing().items()
        if not re.search(SOURCE, one.sections.get("References", ""))
    ]
    assert missing == []


def test_nothing_is_excused_without_need() -> None:
    """Neither what is no longer there nor what has both."""
    there = {one.where: one for one in functions(FULL)}
    needless = [
        name
        for name in WITHOUT_EQUATION
        if name not in there or (_equations(there[name]) and "References" in there[name].sections)
    ]
    assert needless == []


def _computing() -> dict[str, Public]:
    """Functions and methods of `FULL` that are not excused."""
    every = {one.where: one for one in functions(FULL) if not one.where.endswith(SERIALISED)}
    return {where: one for where, one in every.items() if where not in WITHOUT_EQUATION}


def _equations(one: Public) -> list[str]:
    """Whatever is set as mathematics and relates two sides, outside of arguments and examples."""
    prose = one.sections[""] + "\n\n" + one.sections.get("Notes", "")
    return [found for found in re.findall(MATHS, prose) if re.search(RELATION, found)]


def _entry(parameters: str, name: str) -> str:
    """Name line and description of one argument."""
    for block in re.split(r"\n(?=\S)", parameters):
        if re.match(rf"[^:]*\b{name}\b", block.strip()):
            return block
    return ""


def _own(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes of a function, those of functions inside it left out."""
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, ast.FunctionDef | ast.Lambda):
            yield from _own(child)


def _is_overload(one: Public) -> bool:
    return any("overload" in ast.unparse(d) for d in getattr(one.node, "decorator_list", []))
