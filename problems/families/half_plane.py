"""Contact of two half planes with the logarithmic kernel: a dense F without a mesh.

Tractions p on the surfaces of two half planes cause the relative displacement (Johnson
1985, "Contact mechanics", Sections 2.2 and 2.3; the factor 2/(πE*) includes both
surfaces)

    u(x) = −2/(πE*) ∫ ln(|x − s|/a) p(s) ds + a constant

along the normal for pressures, and along the tangent for shear tractions, with the half
width a of the contact. Normal and tangential displacements are decoupled because both
bodies are of the same material. With a traction λ_j/h on each of n equal elements of
length h and with u at their midpoints, u = Fλ, where F_ij depends only on |i − j|. F is
positive definite on intervals shorter than 4a. Since the total force is prescribed, the
constant is free: it is the multiplier of the single equation Σλ = force. This is the
form ``dual`` of bodies with one rigid motion.

* law=hertz: min ½λᵀFλ + gᵀλ over λ ≥ 0, Σλ = P, with the gap g = x²/2R. The elements
  cover |x| ≤ 3a/2
* law=cattaneo: min ½λᵀFλ over |λ_i| ≤ μ∫p over element i, Σλ = Q, with the exact
  pressure p. The elements cover |x| ≤ a

Forces are in units of F₀, which is P for normal and μP for tangential forces, and
displacements in units of l = 2F₀/(πE*). Then F is a matrix of logarithms, and Hertz's
gap is (x/a)². Exact tractions are sums of semicircles s_c = 2/(πc)√(1 − x²/c²), with
lengths in units of a. Their energies follow from

    −∫ ln|x − t| s_c(t) dt = ln(2/c) + ½ − x²/c²,  |x| ≤ c,      ∫x²s_c = c²/4
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from mortarbench.harness import (
    QP,
    Case,
    ContactSide,
    Family,
    Fields,
    Matrix,
    Reference,
    Solution,
    Vector,
)
from mortarbench.harness.keys import Range
from mortarbench.problems.contact.sides import ACTIVE_THRESHOLD
from mortarbench.problems.families.half_space.cases import (
    relative_distance,
    surface_fields,
)
from mortarbench.problems.families.hertz import (
    CURVE_POINTS,
    MATERIAL,
    RADIUS,
    UNIT_LOAD,
)
from mortarbench.problems.families.line_contact import LineContact, TangentialContact
from mortarbench.problems.keys import check_fits, check_tangential, refuse_unused

MU = 0.3
LOAD = 10 * UNIT_LOAD  #: normal force P, N/m
SIDE = "half plane on half plane"
#: half width of the potential contact of law=hertz, in units of a
MESH_HALF_WIDTH = 1.5

#: exact solution for two cylinders of the radius and material of the Hertz families
EXACT = LineContact(LOAD, RADIUS / 2, MATERIAL.E / (2 * (1 - MATERIAL.nu**2)))


@dataclass(frozen=True, kw_only=True)
class HalfPlane(Family):
    """Line contact without a mesh: Hertz, or Cattaneo and Mindlin with friction."""

    forms: ClassVar = ("dual",)

    n: Annotated[int, Range(2), "elements"] = 100
    law: Annotated[Literal["hertz", "cattaneo"], "normal or tangential contact"] = (
        "hertz"
    )
    Q: Annotated[float, "tangential force, a fraction of μP"] = 0.0

    def __post_init__(self) -> None:
        """Check that the law admits Q, and the size."""
        super().__post_init__()
        needed = 8 * self.n**2 / 2**20
        check_fits(f"a full matrix of {self.n} rows takes", needed, "a matrix")
        if self.law == "cattaneo":
            check_tangential(self.Q)
        else:
            refuse_unused(self, "Q", "law=hertz", "law=cattaneo")

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case, in form dual."""
        if self.law == "hertz":
            return _hertz_case(self.n)
        return _cattaneo_case(self.n, TangentialContact(EXACT, MU, self.Q))


@dataclass(frozen=True, eq=False)
class Elements:
    """Division of [−width, width] into n equal elements, with lengths in units of a."""

    n: int
    width: float

    @property
    def h(self) -> float:
        """Length of an element."""
        return 2 * self.width / self.n

    @property
    def ends(self) -> Vector:
        """End points (n + 1,) of the elements, ascending."""
        return np.linspace(-self.width, self.width, self.n + 1)

    @property
    def middle(self) -> Vector:
        """Midpoints (n,)."""
        return (self.ends[1:] + self.ends[:-1]) / 2

    @property
    def F(self) -> Matrix:
        """Displacements (n, n) of the midpoints under unit forces on the elements.

        F_ij = −1/h ∫ ln|x_i − s| ds over element j; an antiderivative is t ln|t| − t.
        """
        t = self.h * (np.arange(self.n + 1) - 0.5)
        antiderivative = t * np.log(np.abs(t)) - t
        return toeplitz(-np.diff(antiderivative) / self.h)


def _hertz_case(n: int) -> Case:
    elements = Elements(n, MESH_HALF_WIDTH)
    qp = _dual(elements.F, elements.middle**2, 1.0, np.zeros(n), np.full(n, np.inf))
    x, width = EXACT.a * elements.middle, EXACT.a * elements.h
    approach = displacement(((1.0, 1.0),))
    exact_energy = self_energy(((1.0, 1.0),)) - approach

    def quantities(s: Solution) -> dict[str, Any]:
        """Compare with Hertz's solution.

        Errors are relative; the error of p is in the l² norm. `energy` is the elastic
        energy minus P·approach in J/m; the approach is measured from the level u = 0.
        """
        force = s.x * EXACT.P
        p, hertz = force / width, EXACT.pressure(x)
        # ∫px² = Pa²/4, with the moment of a constant pressure on each element
        half_width = np.sqrt(4 * force @ (x**2 + width**2 / 12) / EXACT.P)
        energy = 0.5 * s.x @ (qp.P @ s.x) + s.y[0]
        return {
            "elements": n,
            "contact_rows": n,
            "active": int((s.x > ACTIVE_THRESHOLD * s.x.max(initial=0.0)).sum()),
            "energy": float(energy) * _energy_unit(EXACT.P),
            "energy_error": float(energy / exact_energy - 1),
            "multiplier_sum": float(force.sum()),
            "force_error": float(force.sum() / EXACT.P - 1),
            "approach_error": float(-s.y[0] / approach - 1),
            "p_max": float(p.max()),
            "p_max_error": float(p.max() / hertz.max() - 1),
            "pressure_l2_error": relative_distance(p, hertz),
            "half_width": float(half_width),
            "half_width_error": float(half_width / EXACT.a - 1),
        }

    curve = EXACT.a * np.linspace(-MESH_HALF_WIDTH, MESH_HALF_WIDTH, CURVE_POINTS)
    exact = np.column_stack([curve, EXACT.pressure(curve), np.zeros(CURVE_POINTS)])

    def fields(s: Solution) -> Fields:
        p = s.x * EXACT.P / width
        gap = -s.z_box * _length_unit(EXACT.P)
        return surface_fields(
            x,
            ContactSide(
                name=SIDE,
                nodes=np.arange(n),
                length=np.full(n, width),
                force=np.outer(p * width, (0.0, 1.0)),
                pressure=p,
                gap=gap,
                exact=exact,
            ),
        )

    return _case(qp, EXACT.P, quantities, fields)


def _cattaneo_case(n: int, exact: TangentialContact) -> Case:
    elements = Elements(n, 1.0)
    F0 = exact.mu * EXACT.P
    bound = np.diff(EXACT.force(EXACT.a * elements.ends)) / EXACT.P
    F = elements.F
    qp = _dual(F, np.zeros(n), exact.Q, -bound, bound)
    x, width = EXACT.a * elements.middle, EXACT.a * elements.h
    exact_displacement = displacement(exact.semicircles)
    exact_energy = self_energy(exact.semicircles) - exact.Q * exact_displacement

    def quantities(s: Solution) -> dict[str, Any]:
        """Compare with Cattaneo and Mindlin's solution.

        Errors are relative; the error of q is in the l² norm. `energy` is the elastic
        energy minus Q·displacement in J/m; `dissipation` is Σg|slip| in J/m, with
        the friction bounds g; `stick_half_width` is the half
        width of the stick zone for which the exact traction has the same ∫x²q;
        `shear_centre` is the mean of q over the one or two elements next to x = 0.
        """
        force = s.x * F0
        q, mindlin = force / width, exact.traction(x)
        moment = float(force @ (x**2 + width**2 / 12))
        c = exact.stick_half_width(moment, EXACT.P * EXACT.a**2 / 4)
        central = slice((n - 1) // 2, n // 2 + 1)  # one element, or two for even n
        centre, at_centre = (float(v[central].mean()) for v in (q, mindlin))
        slips = slipping(s)
        energy = 0.5 * s.x @ (F @ s.x) + exact.Q * s.y[0]
        return {
            "elements": n,
            "contact_rows": n,
            "stick": int((~slips).sum()),
            "slip": int(slips.sum()),
            "open": 0,
            "energy": float(energy) * _energy_unit(F0),
            "energy_error": float(energy / exact_energy - 1),
            "dissipation": float(bound @ np.abs(s.z_box)) * _energy_unit(F0),
            "tangential_force": float(force.sum()),
            "force_error": float(s.x.sum() / exact.Q - 1),
            "shear_centre": centre,
            "shear_centre_error": centre / at_centre - 1,
            "shear_l2_error": relative_distance(q, mindlin),
            "stick_half_width": c,
            "stick_half_width_error": c / exact.c - 1,
        }

    def slipping(s: Solution) -> NDArray[np.bool_]:
        return np.asarray(np.abs(s.x) >= bound * (1 - ACTIVE_THRESHOLD))

    curve = EXACT.a * np.linspace(-MESH_HALF_WIDTH, MESH_HALF_WIDTH, CURVE_POINTS)
    tractions = np.column_stack([curve, EXACT.pressure(curve), -exact.traction(curve)])

    def fields(s: Solution) -> Fields:
        p, q = bound * EXACT.P / width, s.x * F0 / width
        return surface_fields(
            x,
            ContactSide(
                name=SIDE,
                nodes=np.arange(n),
                length=np.full(n, width),
                force=width * np.column_stack([-q, p]),
                pressure=p,
                gap=np.zeros(n),
                shear=-q,
                friction=np.where(slipping(s), "slip", "stick"),
                exact=tractions,
            ),
        )

    return _case(qp, F0, quantities, fields)


def displacement(semicircles: Sequence[tuple[float, float]]) -> float:
    """Return the constant part of u/l under the tractions Σ w·s_c of pairs (w, c).

    In the stick zone, u is this constant, because the parabolas −x²/c² of all
    semicircles sum to zero (or, for normal contact, to Hertz's gap).
    """
    return float(sum(w * (np.log(2 / c) + 0.5) for w, c in semicircles))


def self_energy(semicircles: Sequence[tuple[float, float]]) -> float:
    """Return ½∫q Fq / (F₀l) for the tractions q = Σ w·s_c of pairs (w, c)."""
    total = 0.0
    for v, b in semicircles:
        for w, c in semicircles:
            narrow, wide = sorted((b, c))
            total += v * w * (np.log(2 / wide) + 0.5 - (narrow / wide) ** 2 / 4)
    return float(0.5 * total)


def _dual(F: Matrix, gap: Vector, force: float, lower: Vector, upper: Vector) -> QP:
    """Return the QP  min ½λᵀFλ + gᵀλ,  Σλ = force,  lower ≤ λ ≤ upper."""
    n = gap.size
    return QP(
        P=F,
        q=gap,
        A=np.ones((1, n)),
        b=np.array([force]),
        lb=lower,
        ub=upper,
    )


def _case(
    qp: QP,
    force: float,
    quantities: Callable[[Solution], Mapping[str, Any]],
    fields: Callable[[Solution], Fields],
) -> Case:
    length = _length_unit(force)
    return Case(
        qp=qp,
        recover=lambda s: (qp.P @ s.x) * length,
        quantities=quantities,
        fields=fields,
        scale=-force * length,
        matrices={"F": qp.P, "d": -qp.q, "R": np.ones((qp.q.size, 1))},
    )


def _length_unit(force: float) -> float:
    """Return l = 2F₀/(πE*), m."""
    return 2 * force / (np.pi * EXACT.E_star)


def _energy_unit(force: float) -> float:
    return force * _length_unit(force)
