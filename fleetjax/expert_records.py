"""What the training of the shipped experts gave: a JSON file for each, beside its weights.

Environments judge success by these returns, and supervisors act by the weights, so neither needs the other.
"""

import json
from pathlib import Path

WEIGHTS = Path(__file__).parent / "supervisors" / "weights"


def record(name: str) -> dict:
    """Return the training record of a shipped expert: steps, mean returns, share of full-length episodes.

    Raises:
        FileNotFoundError: if no expert of that name ships.
    """
    return json.loads((WEIGHTS / f"{name}.json").read_text())


def mean_return(name: str) -> float:
    """Return the expert's mean undiscounted return over episodes of full length."""
    return float(record(name)["mean_return_full_length"] or 0)


def success_return(name: str, floor: float) -> float:
    """Return the return above which an episode of full length succeeds: 95 % of the expert's mean, and no less than `floor`."""
    return max(floor, 0.95 * mean_return(name))
