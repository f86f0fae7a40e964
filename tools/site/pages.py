"""Hooks of mkdocs for pages from sources other than docs/*.md, and for formulas.

README, CONTRIBUTING and CHANGELOG become pages of the site. Notebooks in docs/gallery
are executed and converted to pages. Annotations, docstrings and help texts yield the
pages on families, solvers, records, commands and Python names. Formulas, which the
sources contain as LaTeX between dollar signs, are converted to MathML.
"""

from __future__ import annotations

import html
import inspect
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from math_core import LatexError, LatexToMathML

from mortarbench.cli.main import COMMANDS
from mortarbench.solvers import SOLVERS

sys.path.append(str(Path(__file__).parent))
from solver_page import solver_page, table

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}  #: pages of the site by the name of the file in the root of the project
#: formula in the output of pymdownx.arithmatex, displayed or inline
FORMULA = re.compile(
    r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL
)
#: asterisk of a formula, as in u*, that Markdown has interpreted as emphasis
SWALLOWED = re.compile(r"[\w|‖)\]']<em>.{0,60}")
#: environment variables of notebooks and help texts: one thread, 80 columns
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "80"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages for files in the root of the project and for notebooks."""
    from mkdocs.structure.files import File

    os.environ.update(ENVIRONMENT)
    for name, page in PAGES.items():
        text = from_root((ROOT / name).read_text("utf-8"))
        files.append(File.generated(config, page, content=text))
    for page, build in GENERATED.items():
        files.append(File.generated(config, page, content=build()))
    for notebook in sorted((ROOT / "docs" / "gallery").glob("*.ipynb")):
        for path, content in gallery_page(notebook).items():
            files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(
    markdown: str, *, page: Page, config: MkDocsConfig, files: Files
) -> str:
    """Redirect links to files in the root and to notebooks."""
    up = "../" * page.file.src_uri.count("/")
    for name, target in PAGES.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{name}", f"]({up}{target}", markdown)
    if not page.file.src_uri.startswith("gallery/"):
        markdown = re.sub(r"\]\((gallery/[\w-]+)\.ipynb", r"](\1.md", markdown)
    return markdown


def on_page_content(
    content: str, *, page: Page, config: MkDocsConfig, files: Files
) -> str:
    """Convert the formulas of a page to MathML.

    Raises
    ------
    PluginError
        If a formula cannot be converted, or Markdown has interpreted an asterisk in a
        formula as emphasis.

    """
    from mkdocs.exceptions import PluginError

    try:
        return typeset(content)
    except ValueError as e:
        raise PluginError(f"{page.file.src_uri}: {e}") from e


def typeset(content: str) -> str:
    """Replace the formulas in HTML with MathML.

    Raises
    ------
    ValueError
        If a formula cannot be converted, or Markdown has interpreted an asterisk in a
        formula as emphasis.

    """
    if swallowed := SWALLOWED.search(content):
        raise ValueError(f"emphasis within a word: {swallowed[0]}")

    converter = LatexToMathML()

    def converted(formula: re.Match[str]) -> str:
        tag, tex = formula[1], html.unescape(formula[2]).strip()
        display = tag == "div"
        if display and r"\tag{" in tex and r"\begin{" not in tex:
            tex = rf"\begin{{equation}}{tex}\end{{equation}}"
        try:
            mathml = converter.convert_with_local_state(tex, displaystyle=display)
        except LatexError as e:
            raise ValueError(f"formula {tex}: {e}") from None
        return f'<{tag} class="formula">{mathml}</{tag}>'

    return FORMULA.sub(converted, content)


def from_root(text: str) -> str:
    """Adapt the links in a file from the root of the project to the folder docs/."""
    text = re.sub(r"\]\(docs/", "](", text)
    for name, page in PAGES.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text


def family_page() -> str:
    """Return a page with the problem and the keys of every family.

    The problem is described by the docstrings of the class and, for the first family of
    a module, of the module; the keys follow from annotations.
    """
    from mortarbench.harness.keys import keys_of
    from mortarbench.problems import PROBLEMS
    from mortarbench.problems.families import description

    heads, parts, described = ("key", "default", "values", "meaning"), [], set()
    for name, family in PROBLEMS.items():
        kind = type(family)
        docs = [inspect.getdoc(kind)]
        if kind.__module__ not in described:
            docs.append(inspect.getdoc(sys.modules[kind.__module__]))
        described.add(kind.__module__)
        if name == "bodies":
            docs.append(inspect.getdoc(description))
        keys = []
        for key in keys_of(kind).values():
            values, _, meaning = str(key).partition(": ")
            default = "" if key.default is None else f"`{key.default}`"
            keys.append((f"`{key.name}`", default, values, meaning))
        text = re.sub(r"^::\n", "", "\n\n".join(filter(None, docs)), flags=re.M)
        text = text.replace("::\n", ":\n")
        # escape the asterisk of λ* outside of indented code
        text = re.sub(r"^(?! {4})(.*\w)\*", r"\1\\*", text, flags=re.M)
        forms = ", ".join(f"`{form}`" for form in family.forms)
        parts += [f"## {name}", text, f"Forms: {forms}.", table(heads, *keys)]
    return "\n\n".join(
        [
            "# Families of problems",
            "**Which keys may a [case name](cases.md) contain?** An empty default "
            "follows from other keys or from the file of the case.",
            *parts,
        ]
    )


def record_page() -> str:
    """Return a page with a table of the fields of a record, from their annotations."""
    import msgspec

    from mortarbench.harness.record import Record

    _, parts = msgspec.json.schema_components([Record])
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤"}
    rows = []
    for name, field in parts["Record"]["properties"].items():
        kinds = [field, *field.get("anyOf", ())]
        words = [kind["type"] for kind in kinds if "type" in kind] or ["string"]
        limits = [
            f"{sign} {kind[limit]:g}"
            for kind in kinds
            for limit, sign in signs.items()
            if limit in kind and kind[limit] < 2**62
        ]
        text = field["description"]
        rows.append((f"`{name}`", " or ".join(words), ", ".join(limits), text))
    return (
        "# Fields of a record\n\n"
        "A line of the journal is a JSON object with these fields. `results.df`, the "
        "CSV table `measurements` and `records.parquet` have a column for each field. "
        "A value that was not measured is null.\n\n"
        + table(("field", "type", "range", "content"), *rows)
    )


def command_page() -> str:
    """Return a page with the help texts of all commands."""

    def printed(*arguments: str) -> str:
        command = [sys.executable, "-m", "mortarbench", *arguments, "--help"]
        environment = {**os.environ, **ENVIRONMENT}
        return subprocess.run(
            command, check=True, capture_output=True, text=True, env=environment
        ).stdout

    sections = (f"## {c}\n\n```text\n{printed(*c.split())}```" for c in COMMANDS)
    return "\n\n".join(
        [
            "# Commands",
            "**Which options does a command have?** `mortarbench COMMAND --help` "
            "prints these texts. [Exit codes](compare.md#exit-codes) are the same for "
            "all commands.",
            *sections,
        ]
    )


def python_page() -> str:
    """Return a page of directives from which mkdocstrings writes the reference."""
    import mortarbench
    from mortarbench import harness
    from mortarbench.problems import elastic

    # names whose packages of the same name can be called
    paths = {name: f"listing.{name}" for name in ("solvers", "problems")}
    own = [name for name in sorted(mortarbench.__all__) if name not in paths]
    groups = {
        "Functions": [n for n in own if n[0].islower()] + list(paths.values()),
        "Classes": [n for n in own if n[0].isupper()],
        "Further names for plug-ins": [
            f"harness.{n}" for n in sorted(set(harness.__all__) - set(own))
        ],
        "Elastic bodies in plug-ins": [
            f"problems.elastic.{n}" for n in elastic.__all__
        ],
    }
    return "\n\n".join(
        [
            "# Python names",
            "**Which names may a script use?** Those on this page are stable; others "
            "may change. For invalid input, all functions raise `mb.InputError` with a "
            "message of one line. [From Python](python.md) shows how to use them.",
            *(
                "\n".join([f"## {title}\n", *(f"::: mortarbench.{n}" for n in names)])
                for title, names in groups.items()
            ),
        ]
    )


#: functions that return the generated pages, by the name of the page
GENERATED = {
    "commands.md": command_page,
    "families.md": family_page,
    "python-names.md": python_page,
    "records.md": record_page,
    "solvers.md": lambda: solver_page(SOLVERS),
}


def gallery_page(path: Path) -> dict[str, str | bytes]:
    """Execute a notebook in an empty folder; return its page and pictures by path."""
    import nbformat
    from nbconvert import MarkdownExporter
    from nbconvert.preprocessors import ExecutePreprocessor

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        ExecutePreprocessor(timeout=300).preprocess(
            notebook, {"metadata": {"path": folder}}
        )
    exporter = MarkdownExporter()
    text, resources = exporter.from_notebook_node(
        notebook, {"unique_key": path.stem, "output_files_dir": ""}
    )
    note = f"[Download this notebook]({path.name}){{ .download }}\n\n"
    text = re.sub(r"<style scoped>.*?</style>", "", text, flags=re.S)
    text = text.replace('<table border="1" class="dataframe">', "<table>")
    title, _, rest = text.lstrip().partition("\n")
    page = f"{title}\n\n{note}{rest}"
    pictures = {f"gallery/{name}": data for name, data in resources["outputs"].items()}
    return {f"gallery/{path.stem}.md": page, **pictures}
