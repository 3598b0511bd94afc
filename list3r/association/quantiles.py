"""Quantiles of the chi-square and F distributions, from scipy.special: importing scipy.stats takes half a second."""

from __future__ import annotations

from scipy.special import fdtri, gammaincinv


def chi2_quantile(probability: float, freedom: float) -> float:
    """Return the value that a chi-square variable with `freedom` degrees of freedom is below with `probability`."""
    return 2.0 * float(gammaincinv(freedom / 2, probability))


def f_quantile(probability: float, freedom: float, freedom_below: float) -> float:
    """Return the value that an F variable (`freedom` over `freedom_below` degrees) is below with `probability`."""
    return float(fdtri(freedom, freedom_below, probability))
