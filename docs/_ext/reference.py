"""The reference: one page for the exports of each package, and one page for the help of all commands.

A name that several packages export has its entry in the deepest one above its definition, and links
elsewhere.
"""

import argparse
import importlib
import inspect
import pkgutil
import textwrap
from collections.abc import Iterable
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING

# The tests read the exported names through this module without Sphinx.
if TYPE_CHECKING:
    from docutils.nodes import Element, Node
    from sphinx.addnodes import pending_xref
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

ORDER = [
    "worldstate",
    "measurement",
    "state",
    "core",
    "smoothing",
    "frontend",
    "abduction",
    "adapters",
    "simulation",
    "operations",
]


def exports() -> dict[str, list[str]]:
    """Return the exported names of every package that has any, in the order of the pages."""
    import worldstate

    found = {"worldstate": list(worldstate.__all__)}
    for package in pkgutil.walk_packages(worldstate.__path__, "worldstate."):
        if package.ispkg and not package.name.startswith("worldstate.cli"):
            names = list(getattr(importlib.import_module(package.name), "__all__", ()))
            if names:
                found[package.name] = names
    order = {name: rank for rank, name in enumerate(ORDER)}
    return dict(
        sorted(found.items(), key=lambda item: (order.get((item[0] + ".").split(".")[1], 0), item[0]))
    )


def homes(exported: dict[str, list[str]]) -> dict[str, str]:
    """Return the package that holds the entry of every name: the deepest one above its definition."""
    home: dict[str, str] = {}
    for package, names in exported.items():
        for name in names:
            defined = getattr(getattr(importlib.import_module(package), name), "__module__", package)
            best = home.get(name)
            if best is None or _nearness(package, defined) > _nearness(best, defined):
                home[name] = package
    return home


def _nearness(package: str, module: str) -> int:
    """Count the leading folders that a package shares with a module."""
    pairs = zip(package.split("."), module.split("."), strict=False)
    return next((i for i, (a, b) in enumerate(pairs) if a != b), len(package.split(".")))


def kind(value: object) -> str:
    """Return the kind of a directory entry: class, exception, function or data."""
    if inspect.isclass(value):
        return "exception" if issubclass(value, BaseException) else "class"
    return "function" if inspect.isroutine(value) else "data"


def summary(value: object) -> str:
    """Return the first sentence of a docstring; a constant or a type alias is described by its value."""
    if kind(value) == "data":
        if isinstance(value, UnionType):
            return "Type: " + " or ".join(f":py:obj:`{one.__name__}`" for one in value.__args__)
        several = isinstance(value, Iterable) and not isinstance(value, str)
        told = ", ".join(map(str, value)) if several else str(value)
        # A type alias contains asterisks.
        return "Constant: " + told.replace("*", r"\*") + "."
    return " ".join((inspect.getdoc(value) or "").split("\n\n")[0].split())


def entry(package: str, name: str, value: object) -> list[str]:
    """Return the lines of one entry; the example of a constant is evaluated here."""
    if kind(value) != "data":
        return [f".. auto{kind(value)}:: {package}.{name}", *["   :members:"] * inspect.isclass(value), ""]
    asked = f"list({name})" if isinstance(value, dict) else name
    shown = repr(list(value) if isinstance(value, dict) else value)
    example = [f">>> from {package} import {name}", f">>> {asked}", shown]
    return [f".. py:data:: {package}.{name}", "", *(f"   {line}" for line in example), ""]


def page(package: str, names: list[str], home: dict[str, str]) -> str:
    """Return the reST of one package's page."""
    module = importlib.import_module(package)
    lines = [package, "=" * len(package), "", f".. automodule:: {package}", "   :no-members:", ""]
    lines += [".. list-table::", "   :widths: 30 70", ""]
    entries: list[str] = []
    for name in sorted(names, key=str.lower):
        value = getattr(module, name)
        lines += [f"   * - :py:obj:`~{home[name]}.{name}`", f"     - {summary(value)}"]
        if home[name] == package:
            entries += entry(package, name, value)
    return "\n".join([*lines, "", *entries]) + "\n"


def command_line() -> str:
    """Return the reST of the command line: every command with its whole help, group by group."""
    from worldstate.cli.main import PROGRAM

    title = "The command line"
    kept = "What every command keeps to is told in :doc:`/reference/commands`."
    lines = [title, "=" * len(title), "", kept, ""]
    for group in ("", *PROGRAM.groups):
        for name in PROGRAM.members(group):
            words = f"{group} {name}".strip()
            head = f"worldstate {words}"
            told = argparse.ArgumentParser.format_help(PROGRAM.parser(words))
            lines += [head, "-" * len(head), "", "::", "", textwrap.indent(told.rstrip(), "   "), ""]
    return "\n".join(lines)


def write(app: "Sphinx") -> None:
    """Write the changed pages below reference/api/."""
    folder = Path(app.srcdir) / "reference" / "api"
    folder.mkdir(parents=True, exist_ok=True)
    exported = exports()
    home = homes(exported)
    app.reference_homes = home  # type: ignore[attr-defined]
    pages = {f"{package}.rst": page(package, names, home) for package, names in exported.items()}
    pages["command_line.rst"] = command_line()
    toc = "\n".join(f"   {name.removesuffix('.rst')}" for name in pages)
    total = len(home)
    pages["index.rst"] = (
        "Reference\n=========\n\n"
        f"{total} names, each with an example that runs as a test. An embedder needs those of "
        ":py:mod:`worldstate` and little else.\n\n.. toctree::\n   :maxdepth: 1\n\n" + toc + "\n"
    )
    for old in folder.glob("*.rst"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def resolve(app: "Sphinx", env: "BuildEnvironment", node: "pending_xref", text: "Element") -> "Node | None":
    """Link a name, or `Class.member`, to the entry of the exported object."""
    if node.get("refdomain") != "py":
        return None
    parts = node["reftarget"].strip("~.").split(".")
    home: dict[str, str] = app.reference_homes  # type: ignore[attr-defined]
    for tail in (parts[-1:], parts[-2:]):
        if tail[0] in home and (len(parts) <= 2 or parts[0] == "worldstate"):
            target = ".".join([home[tail[0]], *tail])
            return env.domains["py"].resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, text)
    return None


def setup(app: "Sphinx") -> dict[str, bool]:
    """Write the pages before they are read."""
    app.connect("builder-inited", write)
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
