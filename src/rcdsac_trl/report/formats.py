"""How numbers are written: a metric's always with the same decimals, shares in percent."""

import math

from rcdsac_trl.report.read import METRIC_NAMES, SHARES

_DECIMALS = {
    "collisions": 2,
    "goals": 2,
    "mean_speed_m_per_s": 2,
    "spl": 2,
    "smallest_clearance_m": 2,
}
_USUAL_DECIMALS = 1
_PERCENT = 100.0


def number(value: float, metric: str, signed: bool = False) -> str:
    """Write a metric's value, without its unit.

    Example:
        >>> number(0.5, "collisions"), number(-3.14159, "reward"), number(0.5, "collisions", signed=True)
        ('0.50', '-3.1', '+0.50')
        >>> number(0.0061, "contact_fraction")
        '0.6'
    """
    if math.isnan(value):
        return "-"
    shown = _PERCENT * value if metric in SHARES else value
    return f"{shown:{'+' if signed else ''}.{_DECIMALS.get(metric, _USUAL_DECIMALS)}f}"


def interval(low: float, high: float, metric: str, signed: bool = False) -> str:
    """Write an interval of a metric.

    Example:
        >>> interval(0.5, 1.0, "collisions")
        '[0.50, 1.00]'
    """
    return f"[{number(low, metric, signed)}, {number(high, metric, signed)}]"


def heading(metric: str) -> str:
    """Return what stands above a column of a metric, with its unit.

    Example:
        >>> heading("contact_fraction")
        'share of steps in contact, %'
    """
    return METRIC_NAMES[metric] + (", %" if metric in SHARES else "")


def p_value(value: float) -> str:
    """Write a p-value.

    Example:
        >>> p_value(0.0000499), p_value(0.03125)
        ('<0.001', '0.031')
    """
    return "<0.001" if value < 0.001 else f"{value:.3f}"
