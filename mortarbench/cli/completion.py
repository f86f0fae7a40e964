"""The command `completion`: complete commands, options and names in a shell."""

from __future__ import annotations

from typing import Literal

from argcomplete import autocomplete
from argcomplete.completers import ChoicesCompleter
from argcomplete.shell_integration import shellcode

from mortarbench.cli.parser import Parser
from mortarbench.registries import Registries


def completion(registries: Registries, shell: Literal["bash", "zsh"]) -> int:
    """Print a script that completes commands, options and names in bash or zsh.

    To load it, add ``eval "$(mortarbench completion bash)"`` to ~/.bashrc, or ``eval
    "$(mortarbench completion zsh)"`` to ~/.zshrc, after compinit.

    shell : name of the shell
    """
    print(shellcode(["mortarbench"], shell=shell))
    return 0


def complete(registries: Registries, parser: Parser) -> None:
    """Print completions for the script of the shell, and end this process."""
    families = registries.families.items()
    names = {
        "solver": [*registries.solvers],
        "suite": [path.stem for path in registries.suites.glob("*.toml")],
        "case": [
            f"{name}/{form}" for name, family in families for form in family.forms
        ],
    }  #: known values by argument
    for action in parser.arguments():
        if action.dest.removesuffix("s") in names:
            known = dict.fromkeys(names[action.dest.removesuffix("s")], "")
            action.completer = ChoicesCompleter(known)  # type: ignore[attr-defined]
    autocomplete(parser)
