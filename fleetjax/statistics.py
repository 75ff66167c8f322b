"""What several seeds tell: intervals of means, and how one group of runs differs from another.

References: B. Efron, Better bootstrap confidence intervals, 1987; R. Agarwal et al., Deep reinforcement learning at the edge of
the statistical precipice, 2021.
"""

from collections.abc import Callable

import numpy as np

MIN_SEEDS = 5  # below this a bootstrap has too few different resamples, and the range tells more
CONFIDENCE = 0.95
RESAMPLES = 9999


def mean_bounds(values: np.ndarray, resamples: int = RESAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % BCa interval of means over seeds, or the range of fewer than `MIN_SEEDS` values.

    Args:
        values: f64[S, ...].
        resamples: bootstrap samples. They are the same in every call, so that the result is.

    Returns:
        f64[...] lower and upper bounds.

    >>> low, high = mean_bounds(np.array([3.0, 1.0, 2.0]))
    >>> float(low), float(high)
    (1.0, 3.0)
    """
    if len(values) < MIN_SEEDS:
        return values.min(axis=0), values.max(axis=0)
    return _bca((values,), resamples)


def difference_bounds(values: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % BCa interval of the difference between two means, or the range of differences of few seeds.

    Args:
        values: f64[S].
        others: f64[R], not paired with them.
    """
    if min(len(values), len(others)) < MIN_SEEDS:
        return values.min() - others.max(), values.max() - others.min()
    return _bca((values, others), RESAMPLES)


def ratio_bounds(values: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % BCa interval of the ratio of two means over the same seeds, or the range of the ratios of few seeds.

    Args:
        values: f64[S].
        others: f64[S] of the same seeds, all > 0.
    """
    ratios = values / others
    if len(values) < MIN_SEEDS or np.ptp(ratios) == 0:  # BCa is undefined for constants
        return ratios.min(), ratios.max()
    return _bca((values, others), RESAMPLES, _ratio, paired=True)


def _difference(first: np.ndarray, *second: np.ndarray, axis: int) -> np.ndarray:
    return first.mean(axis=axis) - (second[0].mean(axis=axis) if second else 0.0)


def _ratio(first: np.ndarray, second: np.ndarray, axis: int) -> np.ndarray:
    return first.mean(axis=axis) / second.mean(axis=axis)


def _bca(
    samples: tuple[np.ndarray, ...], resamples: int, statistic: Callable[..., np.ndarray] = _difference, *, paired: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the BCa interval of a statistic of samples: of the mean of one, or the difference between the means of two."""
    from scipy import stats  # takes a second to import

    observed = np.asarray(statistic(*samples, axis=0))
    low, high = observed.copy(), observed.copy()
    varies = np.any([np.any(sample != sample[:1], axis=0) for sample in samples], axis=0)  # BCa is undefined for constants
    if np.any(varies):
        varying = tuple(sample[:, varies] if sample.ndim > 1 else sample for sample in samples)
        options = {
            "n_resamples": resamples,
            "confidence_level": CONFIDENCE,
            "method": "BCa",
            "vectorized": True,
            "paired": paired,
        }
        interval = stats.bootstrap(varying, statistic, axis=0, rng=np.random.default_rng(0), **options).confidence_interval
        low[varies], high[varies] = interval
    return low, high


def interquartile_mean(values: np.ndarray) -> float:
    """Return the mean of the middle half of values f64[S]: the lowest and the highest quarter, rounded down, are left out.

    >>> interquartile_mean(np.array([1.0, 2.0, 3.0, 100.0]))
    2.5
    """
    from scipy import stats

    return float(stats.trim_mean(values, 0.25))


def probability_higher(values: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """Return the probability that one of `values` exceeds one of `others`, ties counting half, and its p value.

    Args:
        values: f64[S].
        others: f64[R].

    Returns:
        P(X > Y) + P(X = Y) / 2, and the two-sided p value of the Mann-Whitney test against 1/2.

    >>> probability_higher(np.array([1.0, 2.0]), np.array([1.0, 2.0]))
    (0.5, 1.0)
    """
    from scipy import stats

    statistic, p_value = stats.mannwhitneyu(values, others)
    return float(statistic) / (len(values) * len(others)), float(p_value)
