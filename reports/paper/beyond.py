"""The sections that the paper does not have: of accuracy, and of solvers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mortarbench.harness.files.experiment import Experiment
from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.document.formatting import TIMED, plural
from mortarbench.reports.document.layout import Picture, Section
from mortarbench.reports.paper.contact import (
    CONTACTS,
    active,
    pressure_figure,
    verification_figure,
    zoom_figure,
)
from mortarbench.reports.paper.fleet import (
    DUALS,
    certified_figure,
    certified_table,
    fleet_figure,
    fleet_table,
    primal_dual_figure,
    totals_table,
)
from mortarbench.reports.paper.stepping import SINCE, orders, stepping_figure

REPEATED = (
    "Medians of interleaved, randomised repeats in worker processes of their own, with "
    "the distribution-free 95 % interval of the median (below six repeats: smallest "
    "and largest). Every answer is judged on the QP as given, by its "
    "residuals or for small QPs by a proven optimum; only verified answers have times."
)


def physics(experiment: Experiment) -> tuple[Section, ...]:
    """Show the contact closely, both methods, and the accuracy of the stepping."""
    return (_contact(experiment), _methods(experiment), _stepping(experiment))


def _contact(experiment: Experiment) -> Section:
    rows = experiment.tables["pressures"]
    followed = active(rows, "nts")
    last = max(followed)
    zoom = (
        f"The contact at load step {last}, node-to-segment, to scale (displacement × 1)"
        ". Orange: contact pressures on the ring's nodes (dots), each drawn along the "
        "normal of its contact row; the arrow in the corner is their scale. Pressure: "
        "nodal force over the undeformed arc that belongs to the node."
    )
    pressures = (
        "Contact pressure against the angle around the ring's centre, from its right "
        f"foot on: (a) through the {last} load steps, (b) both methods at the last. "
        f"(c): the active set, which grows from {plural(len(followed[1]), 'node')} to "
        f"{len(followed[last])} (node-to-segment; a node is active if its force "
        "exceeds 1e-6 of the largest)."
    )
    return Section(
        name="contact",
        title="Beyond the paper: the contact",
        pictures=(
            Picture(
                name="zoom",
                caption=zoom,
                figure=zoom_figure(experiment.states["largest"]),
            ),
            Picture(name="pressure", caption=pressures, figure=pressure_figure(rows)),
        ),
    )


def _methods(experiment: Experiment) -> Section:
    rows = experiment.tables["verification"]
    worst = {
        contact: max(
            float(r["error"]) for r in rows
            if r["problem"] == "patch" and r["contact"] == contact
        )
        for contact in CONTACTS
    }  # fmt: skip
    finest = max(int(r["n"]) for r in rows if r["problem"] == "patch")
    (left,) = (
        float(r["error"]) for r in rows
        if (r["problem"], r["contact"], r["n"]) == ("patch", "nts", finest)
    )  # fmt: skip
    caption = (
        "Contact rows against exact solutions. (a): largest error of σy at any Gauss "
        "point of the patch test, 3 elements meeting 2 (errors below 1e-12 are "
        f"rounding and drawn there): node-to-segment keeps {100 * left:.2g} % on the "
        f"finest mesh, mortar has {worst['mortar']:.0e} at most. (b): pressure between "
        "two cylinders against Hertz's, in L²; it cannot fall below the order a²/R² "
        "of the finite bodies."
    )
    picture = Picture(
        name="verification", caption=caption, figure=verification_figure(rows)
    )
    return Section(
        name="methods",
        title="Beyond the paper: node-to-segment against mortar",
        prose=(
            "What the paper calls mortar is node-to-segment collocation. On its "
            "benchmark both give nearly the same pressures (the figure above); on "
            "problems with exact solutions they do not.",
        ),
        pictures=(picture,),
    )


def _stepping(experiment: Experiment) -> Section:
    plan: Mapping[str, Any] = experiment.setting["plan"]
    rows = experiment.tables["stepping"]
    Nr, Nh = plan["stepped"]
    settled = rows[-1]
    caption = (
        f"Error of the load steps at Nr = {Nr}, Nh = {Nh} (node-to-segment) against "
        f"their number; what they approach is {settled['relin']} linearisations in "
        f"each of {settled['steps']} steps, where contact holds as linearised at the "
        "solution itself. The errors are those of the stepping alone, every QP being "
        "solved to rounding."
    )
    return Section(
        name="stepping",
        title="Beyond the paper: accuracy of the load steps",
        prose=(
            "The paper linearises the contact once per step, at the solution of the "
            "step before, and gives no error. It is of first order in 1/steps; "
            f"orders are fitted from {SINCE} steps on, with Student's interval.",
        ),
        tables=(orders(rows),),
        pictures=(
            Picture(name="stepping", caption=caption, figure=stepping_figure(rows)),
        ),
    )


def fleet(evidence: Evidence) -> tuple[Section, ...]:
    """Show how SMALBE and the others grow with m, and primal against dual."""
    grown = (
        "Time against the size m of the dual at the last load step, tolerance 1e-6, "
        "verified answers only; crosses: tried and not verified. Bars: interval of the "
        f"median. {TIMED}"
    )
    totals = (
        "Primal totals beside dual totals, the latter with the dualisation of one "
        "load step, its factorisation included (over ten steps, the factorisation is "
        "shared); verified answers only, crosses: tried and not verified. SMALBE takes "
        "bounds and equalities, so no primal form."
    )
    return (
        Section(
            name="fleet",
            title="Beyond the paper: SMALBE against the fleet",
            prose=(REPEATED,),
            tables=tuple(fleet_table(evidence, form) for form in DUALS),
            pictures=(
                Picture(name="fleet", caption=grown, figure=fleet_figure(evidence)),
            ),
        ),
        Section(
            name="totals",
            title="Beyond the paper: primal against dual",
            tables=(totals_table(evidence),),
            pictures=(
                Picture(
                    name="totals", caption=totals, figure=primal_dual_figure(evidence)
                ),
            ),
        ),
    )


def certified(evidence: Evidence) -> tuple[Section, ...]:
    """Show the time to certified accuracy."""
    n = max((o.size("dofs") or 0) for o in evidence.flat)
    caption = (
        "Certified relative error of the displacement in the energy norm against the "
        f"median time at n = {n}, a line for each solver through the tolerances asked "
        "for. The certificate is an upper bound computed from the answer alone; it "
        "holds whatever the solver claims."
    )
    return (
        Section(
            name="certified",
            title="Beyond the paper: time to certified accuracy",
            prose=(REPEATED,),
            tables=(certified_table(evidence),),
            pictures=(
                Picture(
                    name="certified", caption=caption, figure=certified_figure(evidence)
                ),
            ),
        ),
    )
