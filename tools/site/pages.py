"""Hook of mkdocs for pages from other sources than docs/*.md, and for formulas.

README, CONTRIBUTING and CHANGELOG become pages beside those of docs/; notebooks of
docs/gallery are run and become pages; the help of each command is inserted into
`commands.md`; formulas, LaTeX between dollars in the sources, become MathML.
"""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from mortarbench.reports.render.formulas import mathml

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}  #: file of the root → page of the site
#: formula in the output of pymdownx.arithmatex, displayed or inline
FORMULA = re.compile(
    r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL
)
#: asterisk of a formula, u*, that Markdown has taken for the begin of emphasis
SWALLOWED = re.compile(r"[\w|‖)\]']<em>.{0,60}")
HELP = "<!-- help of every command -->"  #: replaced by the help texts in commands.md
#: one thread in every library, as in the processes of a run
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "80"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages from files of the root and from notebooks."""
    from mkdocs.structure.files import File

    os.environ.update(ENVIRONMENT)
    for name, page in PAGES.items():
        text = from_root((ROOT / name).read_text("utf-8"))
        files.append(File.generated(config, page, content=text))
    for notebook in sorted((ROOT / "docs" / "gallery").glob("*.ipynb")):
        for path, content in gallery_page(notebook).items():
            files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(
    markdown: str, *, page: Page, config: MkDocsConfig, files: Files
) -> str:
    """Redirect links to files of the root and to notebooks; insert help texts."""
    up = "../" * page.file.src_uri.count("/")
    for name, target in PAGES.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{name}", f"]({up}{target}", markdown)
    if not page.file.src_uri.startswith("gallery/"):
        markdown = re.sub(r"\]\((gallery/[\w-]+)\.ipynb", r"](\1.md", markdown)
    return markdown.replace(HELP, help_texts()) if HELP in markdown else markdown


def on_page_content(
    content: str, *, page: Page, config: MkDocsConfig, files: Files
) -> str:
    """Convert the formulas of a page.

    Raises
    ------
    PluginError
        If a formula cannot be converted, or Markdown has taken one for emphasis.

    """
    from mkdocs.exceptions import PluginError

    try:
        return typeset(content)
    except ValueError as e:
        raise PluginError(f"{page.file.src_uri}: {e}") from e


def typeset(content: str) -> str:
    """Replace the formulas in HTML by MathML.

    Raises
    ------
    ValueError
        If a formula cannot be converted, or Markdown has taken one for emphasis.

    """
    if swallowed := SWALLOWED.search(content):
        raise ValueError(f"emphasis within a word: {swallowed[0]}")

    def converted(formula: re.Match[str]) -> str:
        tag, tex = formula[1], html.unescape(formula[2]).strip()
        return f'<{tag} class="formula">{mathml(tex, display=tag == "div")}</{tag}>'

    return FORMULA.sub(converted, content)


def from_root(text: str) -> str:
    """Return the text of a file of the root, with links as in the folder docs/."""
    text = re.sub(r"\]\(docs/", "](", text)
    for name, page in PAGES.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text


def help_texts() -> str:
    """Return the help of all commands, a section each."""

    def printed(*arguments: str) -> str:
        command = [sys.executable, "-m", "mortarbench", *arguments, "--help"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        return done.stdout

    commands = re.findall(r"^    ([a-z-]+)(?: |$)", printed(), re.M)
    sections = (f"### {c}\n\n```text\n{printed(c)}```\n" for c in commands)
    return "\n".join(sections)


def gallery_page(path: Path) -> dict[str, str | bytes]:
    """Run a notebook in an empty folder; return its page and pictures by path."""
    import nbformat
    from nbconvert import MarkdownExporter
    from nbconvert.preprocessors import ExecutePreprocessor

    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        ExecutePreprocessor(timeout=300).preprocess(
            notebook, {"metadata": {"path": folder}}
        )
    exporter = MarkdownExporter()
    prefix = f"{path.stem}_"
    text, resources = exporter.from_notebook_node(
        notebook, {"unique_key": path.stem, "output_files_dir": ""}
    )
    note = f"[Download this notebook]({path.name}){{ .download }}\n\n"
    text = re.sub(r"<style scoped>.*?</style>", "", text, flags=re.S)
    text = text.replace('<table border="1" class="dataframe">', "<table>")
    title, _, rest = text.lstrip().partition("\n")
    files: dict[str, str | bytes] = {
        f"gallery/{path.stem}.md": f"{title}\n\n{note}{rest}"
    }
    for name, content in resources["outputs"].items():
        files[f"gallery/{name}"] = content
    assert all(name.startswith(prefix) for name in resources["outputs"])
    return files
