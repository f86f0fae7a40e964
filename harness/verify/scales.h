/* Scales and errors of KKT residuals for single numbers. `scales.pyx` applies them to
   arrays; solvers call them in their own loops. */

#ifndef SCALES_H
#define SCALES_H
#include <math.h>

enum {
    /* Largest ratio of the scale of energy to the objective: at tol 1e-8, 10·tol times the
       scale is then at most 1e-3 of the objective, which is three digits. Without this
       limit, `test_a_cancelling_objective_is_accurate_relative_to_its_terms` fails. */
    MAX_CANCELLATION = 10000,
    /* Violations, and errors of the objective relative to a proven optimum, are divided by
       at most this factor times their terms. As residuals of up to 10·tol are accepted,
       errors of up to 100·tol times the terms are accepted as well.
       With 100, `test_a_narrow_box_does_not_increase_the_scale_of_a_row` fails. */
    TERMS_FACTOR = 10,
    /* Largest size of a variable, in units of the length over which the energy changes
       by E.
       `test_a_wrong_point_is_refuted_by_residuals` (case 15) fails with 1e5,
       `test_a_row_of_large_variables_is_satisfied_to_their_accuracy` with 10. */
    MAX_LENGTHS = 1000
};

#define FORMULA static inline __attribute__((always_inline)) double

/* The least and the largest of two numbers; NaN if either is NaN. */
FORMULA least(double a, double b)
{
    return (a > b) | (b != b) ? b : a;
}

FORMULA largest(double a, double b)
{
    return (a < b) | (b != b) ? b : a;
}

/* The scale of energy of a point: t, the largest of |xᵀPx|, |qᵀx| and
   |bᵀy + hᵀz + σ(z_box)|, but at most the larger of MAX_CANCELLATION·|½xᵀPx + qᵀx| and
   t/MAX_CANCELLATION. */
FORMULA energy_scale(double quadratic, double linear, double work)
{
    double terms = largest(largest(fabs(quadratic), fabs(linear)), fabs(work));
    double value = fabs(quadratic / 2 + linear);
    return least(terms, largest(MAX_CANCELLATION * value, terms / MAX_CANCELLATION));
}

/* The size of a variable: |x|, but at least l and at most MAX_LENGTHS·l, where l is the
   length over which the energy changes by E, the smaller of √(E/Pⱼⱼ) and E/|qⱼ|. Infinite
   if the variable has neither curvature nor cost. */
FORMULA variable_size(double energy, double linear, double curvature, double x)
{
    double length = curvature > 0 ? sqrt(energy / curvature) : INFINITY;
    length = least(length, linear != 0 ? energy / fabs(linear) : INFINITY);
    return largest(least(fabs(x), MAX_LENGTHS * length), length);
}

/* |Σₖ Pⱼₖxₖ|/Pⱼⱼ over k ≠ j, the distance by which the other variables shift the
   minimum along j; 0 if Pⱼⱼ = 0. */
FORMULA minimum_shift(double Px, double curvature, double x)
{
    return curvature > 0 ? fabs(Px - curvature * x) / curvature : 0;
}

/* The size oⱼ of a variable, computed without a scale of energy. */
FORMULA own_size(double Px, double curvature, double x)
{
    return TERMS_FACTOR * (fabs(x) + minimum_shift(Px, curvature, x));
}

/* The scale of the violation of a row or bound: |bᵢ| + Σ|aᵢⱼ|Xⱼ; if bᵢ ≠ 0, the smaller of
   this sum and TERMS_FACTOR·|bᵢ| + Σ|aᵢⱼ|oⱼ. `rhs` is |bᵢ|, `sizes` is Σ|aᵢⱼ|Xⱼ, and `own`
   is Σ|aᵢⱼ|oⱼ. */
FORMULA row_scale(double rhs, double sizes, double own)
{
    return rhs > 0 ? least(rhs + sizes, TERMS_FACTOR * rhs + own) : rhs + sizes;
}

/* |error|/scale; 0 if the error is 0, otherwise inf if the scale has overflowed. */
FORMULA ratio(double error, double scale)
{
    double size = scale < INFINITY || scale != scale ? fabs(error) / scale : INFINITY;
    return error == 0 ? 0 : size;
}

/* The excess of |error| over its rounding, at least 0; rounding that is inf or NaN is not
   subtracted. */
FORMULA beyond(double error, double rounding)
{
    return largest(fabs(error) - (rounding < INFINITY ? rounding : 0), 0);
}

/* The smaller of |rᵢ|/`own`, where `own` is the largest absolute term of rᵢ, and |rᵢ|Dᵢ/E.
   `error` is |rᵢ|. Dᵢ is the larger of |xᵢ| and the `step` to the minimum along i, but at
   most the `room` to the bound in that direction, which counts as 0 if it is negative. */
FORMULA balance_error(double error, double own, double step, double x, double room,
                      double energy)
{
    double gain = error * least(largest(fabs(x), step), largest(room, 0));
    return least(ratio(error, own), ratio(error > 0 ? gain : 0, energy));
}

#endif
