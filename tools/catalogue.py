"""Write the documentation pages on the solvers."""

from pathlib import Path

from solver_pages import solvers_pages

from mortarbench.solvers import SOLVERS

for page, text in solvers_pages(SOLVERS).items():
    (Path(__file__).parents[1] / "docs" / page).write_text(text, "utf-8")
