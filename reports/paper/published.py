"""Numbers published in the paper; its figures have no tables of values."""

from __future__ import annotations

PAPER = "Pospíšil, Světlík, Varga, Čermák, CST 2024, doi:10.4203/ccc.9.10.5"
MACHINE = "AMD Ryzen 5 3600, MATLAB R2020a"

#: times in Section 5 for Nr = 30, Nh = 15 and ten load steps, s
SECONDS = {
    "assembly": 0.087,
    "factor": 0.078,
    "contact": 2.064,
    "dualisation": 26.6858,
    "qp": 1.0739,
}
TOTAL = sum(SECONDS.values())
STEPS = 10

#: Table 1: body → N, nodes, elements, dofs, segments
TABLE_1 = {
    "rectangle": (30, 7471, 7200, 14942, 240),
    "ring": (15, 5611, 5400, 11222, 180),
}
TOTALS = (13082, 12600, 26164)  #: nodes, elements, dofs
DOFS = TOTALS[2]
#: m_E + m_I of this problem, computed here because the paper does not state the numbers
ROWS = 186 + 181
SEGMENTS = {"master": 240, "slave": 180}

ERRATA = (
    "Figure 2: 313 nodes (n = 626) do not agree with the text, which prescribes 2·Nh "
    "radial layers of the ring. For Nr = 4, Nh = 3, 2·Nh layers give 424 nodes (n = "
    "848), and Nh layers give 313. Table 1 follows the text. This page shows both "
    "meshes.",
    "Section 3: “n is lower than m” is reversed; m is much lower than n.",
    "Equation (4): RᵀBᵀλ = Rᵀb must read RᵀBᵀλ = Rᵀf; R is n × r, not r × n.",
    "Section 2: m_E is not the number of nodes with non-zero displacement, but the "
    "number of fixed displacement components, 2(Nr + 1) + 4(2Nh + 1).",
    "The plane state and the unit of the load are not stated. We assume plane strain, "
    "as in the library used by the paper, and 0.1 GN per metre of thickness.",
    "The “mortar” method of the paper is node-to-segment collocation. Figure 4 here "
    "shows both node-to-segment and mortar.",
    "Figure 5: a Cholesky factor with fixing nodes applies a generalised inverse, but "
    "not the Moore-Penrose inverse of pinv. On the feasible set both give the same "
    "dual problem, but the matrices of the two multiplications differ.",
    "The text refers to Figure 6 as “Figure 7” and to Figure 5 as “Figure ??”.",
    "The paper does not state tolerances, the penalty, the numbers of contact rows and "
    "active rows, or whether the 0.078 s of the Cholesky factorisation refer to both "
    "bodies. Here, SMALBE solves each dual QP to 1e-8; for the paper's method, it uses "
    "the parameters of the paper's reference [3].",
    "89 % of the published 29.99 s are spent on dualisation and 3.6 % on the QPs: the "
    "conclusions of the paper on QP algorithms rest on these 3.6 %.",
    "Rotations reach 20° and bending stresses several GPa, far beyond the validity of "
    "linear elasticity. Stresses at the clamped and loaded corners grow without bound "
    "as the mesh is refined. The benchmark is purely numerical.",
)
