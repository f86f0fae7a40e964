"""Figures, drawn with matplotlib in one style, and the measurements behind them."""
