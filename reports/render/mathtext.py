"""Labels of figures, which hold formulas as matplotlib reads them, as plain text."""

from __future__ import annotations

import re

_NAMED = {
    "lambda": "λ", "sigma": "σ", "tau": "τ", "rho": "ρ", "mu": "µ", "nu": "ν",
    "alpha": "α", "kappa": "κ", "Gamma": "Γ", "times": "×", "cdot": "·",
    "leq": "≤", "geq": "≥", "infty": "∞", "pm": "±", "approx": "≈", "%": "%",
}  # fmt: skip
_RAISED = str.maketrans("0123456789-+/nkpP.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺ᐟⁿᵏᵖᴾ·")
_LOWERED = str.maketrans("0123456789kij", "₀₁₂₃₄₅₆₇₈₉ₖᵢⱼ")


def plain(text: str) -> str:
    r"""Read mathtext as text: "degrees of freedom $n$" loses its dollars.

    An escaped dollar is one, as `reports.figures.style.legible` writes it.
    """
    parts = re.split(r"(?<!\\)\$", text)
    shown = [_formula(p) if i % 2 else p for i, p in enumerate(parts)]
    return "".join(shown).replace(r"\$", "$").strip()


def _formula(tex: str) -> str:
    tex = tex.replace(r"\|", "‖").replace(r"\,", " ")
    tex = re.sub(r"\\(?:mathrm|mathbf|mathit|text|rm)\b\s*", "", tex)
    tex = re.sub(r"\\([A-Za-z]+|%)", lambda m: _NAMED.get(m[1], m[1]), tex)
    tex = re.sub(r"\^(\{[^}]*\}|.)", lambda m: m[1].strip("{}").translate(_RAISED), tex)
    tex = re.sub(r"_(\{[^}]*\}|.)", lambda m: m[1].strip("{}").translate(_LOWERED), tex)
    return re.sub(r"[{}]", "", tex).replace("  ", " ")
