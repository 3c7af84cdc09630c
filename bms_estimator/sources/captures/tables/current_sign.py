"""Sign of the current in a table: from an option, a state column, the dialect, the settings or the voltage's response."""

from typing import NamedTuple

import numpy as np

from bms_estimator.model.arrays import CurrentSign, Floats
from bms_estimator.model.errors import UserError
from bms_estimator.sources.captures.tables.dialects import OWN
from bms_estimator.sources.captures.tables.layout import Layout, Role
from bms_estimator.sources.captures.tables.voltage_response import LOAD_FRACTION, VoltageResponse

SIGN_TEXTS: dict[CurrentSign, str] = {
    "discharge_positive": "positive on discharge",
    "charge_positive": "positive on charge",
}


MAX_LOADS_WITHOUT_WORD = 0.05
"""Maximum fraction of the rows with a load that have no word, if the states alone give the direction. A row at the change of a
step may have the state of the previous step."""


MIN_OPPOSITE_ROWS, MIN_OPPOSITE_FRACTION = 3, 0.02
"""Minimum number, and fraction, of the rows of one word whose current has the opposite sign. With fewer, the current counts as
unsigned. In a drive cycle with regenerative braking, a discharge has both signs."""


class StateWords(NamedTuple):
    """Words for charge and discharge in a state column."""

    has_words: bool = False
    in_all_loads: bool = False
    """True if almost all rows with a load have a word."""
    sign: CurrentSign | None = None
    """Direction of positive current, if rows with the same word have currents of both signs; otherwise None."""


def find_words(state: Floats, current: Floats) -> StateWords:
    """Return the words in the rows of a table.

    Args:
        state: 1 with a word for discharge, -1 with a word for charge, otherwise another number; shape (n,).
        current: Current in any unit and with any sign, shape (n,).
    """
    has_word = np.abs(state) == 1.0
    if not has_word.any():
        return StateWords()
    is_load = np.abs(current) > LOAD_FRACTION * np.nanmax(np.abs(current), initial=0.0)
    without_word = np.count_nonzero(is_load & ~has_word)
    in_all_loads = bool(without_word <= MAX_LOADS_WITHOUT_WORD * np.count_nonzero(is_load))
    is_signed = any(_has_both_signs(current[is_load & (state == word)]) for word in (-1.0, 1.0))
    if not is_signed:
        return StateWords(has_words=True, in_all_loads=in_all_loads)
    is_positive = np.sum((state * current)[is_load & has_word]) > 0.0
    sign: CurrentSign = "discharge_positive" if is_positive else "charge_positive"
    return StateWords(has_words=True, in_all_loads=in_all_loads, sign=sign)


def _has_both_signs(current: Floats) -> bool:
    opposite = min(np.count_nonzero(current > 0.0), np.count_nonzero(current < 0.0))
    return bool(opposite >= max(MIN_OPPOSITE_ROWS, MIN_OPPOSITE_FRACTION * current.size))


class UserSign(NamedTuple):
    """Direction of positive current that the user configured."""

    option: CurrentSign | None = None
    """Direction given for this capture, which overrides everything else; None: not given."""
    sensor: CurrentSign | None = None
    """Direction of the pack's sensor, used if the format of another program defines none; None: no settings."""


class CurrentDirection(NamedTuple):
    """Direction of positive current in a table, with its reason."""

    sign: CurrentSign
    reason: str
    is_from_states: bool = False
    """True if words in a state column give the direction of the rows that have one."""
    row_factors: Floats | None = None
    """Factors of the rows, 1 on discharge and -1 on charge, of a current without a sign; None for a current with a sign."""
    warning: str = ""
    """Contradiction between the direction and the voltage; empty without one."""

    @property
    def factor(self) -> float:
        """Factor, 1 or -1, that makes discharge positive."""
        return 1.0 if self.sign == "discharge_positive" else -1.0

    @property
    def text(self) -> str:
        """Direction and reason for messages."""
        is_directed = self.is_from_states or self.row_factors is not None
        return f"{'signed' if is_directed else SIGN_TEXTS[self.sign]} ({self.reason})"


def find_direction(
    name: object, layout: Layout, configured: UserSign, response: VoltageResponse, words: StateWords
) -> CurrentDirection:
    """Return the direction of positive current in a table.

    Args:
        name: Name of the table for messages.
        layout: Columns of the table.
        configured: Direction that the user configured.
        response: Direction that the voltage shows.
        words: Words for charge and discharge in the state column.

    Raises:
        UserError: The current has no sign, and the voltage does not show the direction of each load.
    """
    if configured.option:
        return CurrentDirection(configured.option, "--current-sign")
    if direction := _column_direction(layout, words):
        return direction
    direction = _defined_direction(layout, configured)
    if direction is None and response.sign is not None:
        direction = CurrentDirection(response.sign, "response of the voltage")
    if direction is None:
        direction = CurrentDirection("discharge_positive", "assumed: the file does not show it; --current-sign sets it")
    if words.in_all_loads or (words.has_words and not response.has_no_sign):
        return CurrentDirection(direction.sign, f"column {layout.columns[Role.STATE].name}", is_from_states=True)
    if response.has_no_sign:
        return _direction_of_unsigned(name, layout, direction, response)._replace(is_from_states=words.has_words)
    if response.sign is None or response.sign == direction.sign:
        return direction
    warning = (
        f"the current should be {SIGN_TEXTS[direction.sign]} ({direction.reason}), but the voltage shows that it is "
        f"{SIGN_TEXTS[response.sign]}: if so, use --current-sign {response.sign}"
    )
    return direction._replace(warning=warning)


def _column_direction(layout: Layout, words: StateWords) -> CurrentDirection | None:
    """Return the direction that separate columns or the states of a signed current show; None without them."""
    if Role.CHARGE_CURRENT in layout.columns:
        return CurrentDirection("discharge_positive", "separate columns of charge and discharge")
    if words.sign is not None:
        return CurrentDirection(words.sign, f"column {layout.columns[Role.STATE].name}")
    return None


def _direction_of_unsigned(
    name: object, layout: Layout, direction: CurrentDirection, response: VoltageResponse
) -> CurrentDirection:
    """Return the direction of a current without a sign. A table with this project's columns keeps its direction, with a warning.

    Raises:
        UserError: The voltage does not show the direction of each load.
    """
    found = "the current has no sign, although the voltage shows charge and discharge"
    remedy = "export a signed current or a column of states, or give a file for each direction, with --current-sign"
    if layout.dialect is OWN:
        return direction._replace(warning=f"{found}: {remedy}")
    if response.row_factors is None:
        raise UserError(
            f"{name}: the current has no sign, and the voltage does not show the direction of each load: {remedy}"
        )
    reason = "unsigned in the file; the voltage shows the direction of each load"
    return CurrentDirection("discharge_positive", reason, row_factors=response.row_factors)


def _defined_direction(layout: Layout, configured: UserSign) -> CurrentDirection | None:
    """Return the direction that the format or the settings define; None if neither does.

    A table with this project's columns may come from the pack itself; therefore the settings of its sensor decide first.
    """
    if layout.dialect.current_sign:
        return CurrentDirection(layout.dialect.current_sign, f"convention of {layout.dialect.name}")
    if configured.sensor:
        return CurrentDirection(configured.sensor, "sensor.current_sign")
    if layout.dialect is OWN:
        return CurrentDirection("discharge_positive", f"convention of {OWN.name}")
    return None
