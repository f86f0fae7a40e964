"""Write mortarbench/catalogue.json and the documentation pages on the solvers."""

import json
from pathlib import Path

from solver_pages import solvers_pages

from mortarbench.listing import CATALOGUE, describe
from mortarbench.solvers import SOLVERS

CATALOGUE.write_text(
    json.dumps({name: describe(s) for name, s in SOLVERS.items()}, indent=1) + "\n"
)
for page, text in solvers_pages(SOLVERS).items():
    (Path(__file__).parents[1] / "docs" / page).write_text(text, "utf-8")
