"""The picture of a deformed state: bodies with contact forces, or maps of tractions."""

from __future__ import annotations

from matplotlib.figure import Figure

from mortarbench.harness import Fields, InputError
from mortarbench.reports.figures.deformed import automatic_scale, deformed_figure
from mortarbench.reports.figures.drawing import draw_fields
from mortarbench.reports.figures.maps import traction_maps
from mortarbench.reports.figures.tractions import loaded_sides, traction_figure


def fields_figure(fields: Fields, scale: float | None = None) -> Figure:
    """Draw deformed bodies; without cells, the tractions on their surface.

    scale : magnification of the displacement; None: `automatic_scale`

    Raises
    ------
    InputError
        If there is nothing to draw, or a value is not finite.

    """
    if len(fields.cells):
        return draw_fields(deformed_figure(fields, scale))
    if loaded_sides(fields):
        return traction_figure(fields)
    maps = traction_maps(fields)
    if maps is None:
        raise InputError("no picture: the case has neither bodies nor tractions")
    return draw_fields(maps)


def description(fields: Fields) -> str:
    """Describe the picture in a few words, for a caption."""
    if not len(fields.cells):
        return "tractions on the surface"
    return f"deformed (displacement × {automatic_scale(fields):g}), with contact forces"
