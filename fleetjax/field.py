"""What is known of a parameter of a run: its meaning, unit, default and range."""

from typing import Any, NamedTuple


class Field(NamedTuple):
    """What is known of a parameter, be it a field of `Config` or an algorithm's own.

    Attributes:
        help: meaning.
        unit: unit, or "".
        kind: `str`, `int`, `float`, `bool` or `tuple`.
        traced: whether it is an array that can be swept without compiling anew; an algorithm's own parameters always are.
        low: smallest allowed value.
        high: largest allowed value.
        default: value unless another is given.
    """

    help: str
    unit: str = ""
    kind: type = float
    traced: bool = True
    low: float | None = 0
    high: float | None = None
    default: Any = 0.0
