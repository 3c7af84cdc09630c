"""Questions about a new pack, in the order in which the terminal and the page ask them. Each answer is also an option.

The number of cells in series is suggested from the measured voltage and the chemistry.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel, ValidationError

from bms_estimator.estimator.settings_plausibility import ABOVE_FULL_V, BELOW_EMPTY_V, MAX_CAPACITY_AH
from bms_estimator.estimator.settings_records import ocv_grid
from bms_estimator.model.cell import generic_cells, load_cell, shipped_cells
from bms_estimator.model.config_file import error_reason, without_secrets
from bms_estimator.settings.pack import PackSettings
from bms_estimator.setup.answers import Answers, InvalidAnswerError, parse_number
from bms_estimator.setup.broker_login import ADDRESS_FORM, BrokerLogin

COMMON_COUNTS = (1, 2, 3, 4, 6, 7, 8, 10, 12, 13, 14, 15, 16, 20, 24)
"""Numbers of cells in series of common packs."""


@dataclass(frozen=True)
class CellVoltages:
    """Voltage of a cell of one chemistry [V]."""

    min_v: float
    """Lowest plausible voltage, under load."""
    mid_v: float
    """OCV at SOC 0.5."""
    max_v: float
    """Highest plausible voltage, while it is charged."""


def cell_voltages(cell: str) -> CellVoltages:
    """Return the voltages of one cell of a generic cell or a shipped cell file."""
    model = load_cell(cell, 1.0)
    ocv_v = ocv_grid(model)[0] / model.cell.series_count
    return CellVoltages(float(ocv_v[0]) - BELOW_EMPTY_V, float(ocv_v[len(ocv_v) // 2]), float(ocv_v[-1]) + ABOVE_FULL_V)


def possible_counts(voltage_v: float, cell: CellVoltages) -> range:
    """Return the plausible numbers of cells in series of a pack with this voltage [V]."""
    return range(max(math.ceil(voltage_v / cell.max_v), 1), math.floor(voltage_v / cell.min_v) + 1)


def suggest_count(voltage_v: float, cell: CellVoltages) -> int | None:
    """Return the most plausible number of cells in series; None if no number is possible.

    Numbers of common packs take precedence. Among them the best brings the cells closest to their OCV at SOC 0.5.
    """
    possible = possible_counts(voltage_v, cell)
    candidates = [count for count in possible if count in COMMON_COUNTS] or list(possible)
    return min(candidates, key=lambda count: abs(voltage_v / count - cell.mid_v), default=None)


CHEMISTRIES: Mapping[str, str] = {
    "lfp": "LFP, LiFePO4: 3.2 V per cell",
    "nmc": "NMC: 3.7 V per cell, most e-bikes and cars",
    "nca": "NCA: 3.6 V per cell, many 18650 cells",
    "lco": "LCO: 3.7 V per cell, phones and laptops",
    "lmo": "LMO: 3.8 V per cell",
    "lto": "LTO, titanate: 2.4 V per cell",
}
"""Descriptions of the generic cells by name."""
USUAL_LIMITS_V: Mapping[str, tuple[float, float]] = {
    "lfp": (3.5, 2.8),
    "nmc": (4.2, 3.0),
    "nca": (4.2, 3.0),
    "lco": (4.2, 3.0),
    "lmo": (4.2, 3.0),
    "lto": (2.7, 1.8),
}
"""Usual voltages per cell at which the charger stops, and at which the BMS ends a discharge, by generic cell [V]."""
SYNONYMS = {
    synonym.lower(): name
    for name, description in CHEMISTRIES.items()
    for synonym in description.partition(":")[0].split(", ")
}
"""Names of the generic cells by the names in their descriptions, in lower case."""
NONE = "none"
"""Answer for a service without a broker, a voltage or current without a configured limit, and a device whose SOC is not used."""
DEFAULT_DEVICE_SOC_STD = "10"
"""Default standard deviation of the SOC that a device reports [%], a usual drift of coulomb counters between two full charges."""


@dataclass(frozen=True)
class Question:
    """Question about the pack."""

    name: str
    """Name of the answer in ``Answers``. The option is the same name with dashes."""
    text: str
    help: str
    parse: Callable[[str, Answers], object]
    """Function that converts the text of an answer, or raises InvalidAnswerError."""
    suggest: Callable[[Answers], str]
    """Function that returns the default answer; empty without one."""
    choices: tuple[tuple[str, str], ...] = ()
    """Common answers with their descriptions."""
    explanation: str = ""
    """Explanation of the answer in one line; empty without one."""
    hint: str = ""
    """Meaning of an empty field on the page while the default is unknown."""
    is_asked: Callable[[Answers], bool] = lambda _: True
    """Function that returns False if the question does not concern this device."""

    @property
    def option(self) -> str:
        """Option of the command line."""
        return f"--{self.name.replace('_', '-')}"

    def answer(self, text: str, answers: Answers) -> Answers:
        """Return the answers with the parsed text as the answer to this question.

        Raises:
            InvalidAnswerError: The text is malformed or implausible.
        """
        values: dict[str, Any] = {self.name: self.parse(text.strip(), answers)}
        return replace(answers, **values)


def _validated(model: type[BaseModel], key: str, value: object) -> object:
    """Return a value as the setting ``key`` accepts it.

    Raises:
        InvalidAnswerError: The setting rejects the value.
    """
    try:
        return getattr(model.model_validate({key: value}), key)
    except ValidationError as error:
        detail = error.errors()[0]
        description = model.model_fields[key].description
        raise InvalidAnswerError(f"{without_secrets(str(value))}: {error_reason(detail)} ({description})") from None


def _parse_cell(text: str, answers: Answers) -> object:
    name = SYNONYMS.get(text.lower(), text.lower())
    if name not in (*generic_cells(), *shipped_cells()):
        raise InvalidAnswerError(f"{text}: must be one of {', '.join((*generic_cells(), *shipped_cells()))}")
    if answers.voltage_v is not None and not possible_counts(answers.voltage_v, cell_voltages(name)):
        raise InvalidAnswerError(f"{text}: no number of such cells in series has {answers.voltage_v:.2f} V")
    return name


def _parse_capacity(text: str, _: Answers) -> object:
    value = _validated(PackSettings, "capacity_ah", parse_number(text, "Ah"))
    if isinstance(value, float) and value > MAX_CAPACITY_AH:
        raise InvalidAnswerError(f"{text}: no cell has more than {MAX_CAPACITY_AH:g} Ah; is it in mAh?")
    return value


def _parse_series(text: str, answers: Answers) -> object:
    series = _validated(PackSettings, "series", _integer(text))
    reported = answers.device.cells
    if reported is not None and series != reported:
        raise InvalidAnswerError(f"{text}: the device reports {reported} cells in series")
    if answers.voltage_v is None or answers.cell is None or not isinstance(series, int):
        return series
    possible = possible_counts(answers.voltage_v, cell_voltages(answers.cell))
    if series not in possible:
        raise InvalidAnswerError(
            f"{text}: the pack has {answers.voltage_v:.2f} V, which is {answers.voltage_v / series:.2f} V per cell; "
            f"{possible.start} to {possible.stop - 1} {answers.cell} cells in series are possible"
        )
    return series


def _parse_limit_v(key: str, text: str, answers: Answers, *, above_middle: bool) -> object:
    """Return a voltage limit of the pack [V], above or below its voltage at SOC 0.5.

    Raises:
        InvalidAnswerError: Such a pack never has this voltage at that end.
    """
    value = _validated(PackSettings, key, parse_number(text, "V"))
    if answers.cell is None or answers.series is None or not isinstance(value, float):
        return value
    cell = cell_voltages(answers.cell)
    low_v, high_v = (cell.mid_v, cell.max_v) if above_middle else (cell.min_v, cell.mid_v)
    if not answers.series * low_v <= value <= answers.series * high_v:
        raise InvalidAnswerError(
            f"{text}: must be {answers.series * low_v:.4g} to {answers.series * high_v:.4g} V, the voltage of "
            f"{answers.series} {answers.cell} cells in series"
        )
    return value


def _suggest_limit_v(answers: Answers, index: int) -> str:
    """Return the usual voltage limit of the pack; empty before its cells are known. A shipped cell file has its own limits."""
    if answers.cell is None or answers.series is None:
        return ""
    if answers.cell not in USUAL_LIMITS_V:
        return NONE
    return f"{answers.series * USUAL_LIMITS_V[answers.cell][index]:g}"


def _reports_soc(answers: Answers) -> bool:
    return answers.device.soc is not None or (answers.measured is not None and answers.measured.soc is not None)


def _suggest_capacity(answers: Answers) -> str:
    """Return the capacity that the device reports for the pack, which is that of a cell unless cells are in parallel."""
    return "" if answers.device_capacity_ah is None else f"{answers.device_capacity_ah:g}"


def _parse_broker(text: str, answers: Answers) -> object:
    if text == NONE:
        return None
    try:
        login = BrokerLogin.parse(text)
    except ValueError as error:
        raise InvalidAnswerError(f"{without_secrets(text)}: {error}") from None
    found = answers.device.broker or answers.found_broker
    return found if found and login == BrokerLogin(found.url) else login


def _suggest_broker(answers: Answers) -> str:
    found = answers.device.broker or answers.found_broker
    return found.url if found else NONE


def _suggest_series(answers: Answers) -> str:
    if answers.device.cells is not None:
        return str(answers.device.cells)
    if answers.voltage_v is None or answers.cell is None:
        return ""
    return str(suggest_count(answers.voltage_v, cell_voltages(answers.cell)) or "")


def _integer(text: str) -> int:
    value = parse_number(text)
    if value != int(value):
        raise InvalidAnswerError(f"{text}: must be a whole number")
    return int(value)


QUESTIONS = (
    Question(
        "name",
        "Name of the pack",
        "name of the pack, also in MQTT topics: letters, digits, _ and -",
        lambda text, _: _validated(PackSettings, "name", text),
        lambda answers: answers.name or "pack",
    ),
    Question(
        "cell",
        "Chemistry of the cells",
        "chemistry (lfp, nmc, nca, lco, lmo or lto) or shipped cell",
        _parse_cell,
        lambda _: "",
        tuple(CHEMISTRIES.items()),
    ),
    Question(
        "capacity_ah",
        "Capacity of one cell [Ah]",
        "rated capacity of one cell [Ah]",
        _parse_capacity,
        _suggest_capacity,
    ),
    Question(
        "series",
        "Cells in series",
        "number of cells in series",
        _parse_series,
        _suggest_series,
        hint="empty: the number that fits the measured voltage",
    ),
    Question(
        "parallel",
        "Cells in parallel",
        "number of cells in parallel",
        lambda text, _: _validated(PackSettings, "parallel", _integer(text)),
        lambda _: "1",
    ),
    Question(
        "full_voltage_v",
        "Voltage of the pack at which its charger stops [V]",
        f"voltage of the pack at which its charger stops, which is 100 % [V]; {NONE}: that of the cell file",
        lambda text, answers: (
            None if text == NONE else _parse_limit_v("full_voltage_v", text, answers, above_middle=True)
        ),
        lambda answers: _suggest_limit_v(answers, 0),
        explanation="The SOC is 100 % at this voltage: see the charger's manual. If the charger does not reach it, 100 % is never reported.",
        hint="empty: usual for the chemistry",
    ),
    Question(
        "cutoff_voltage_v",
        "Voltage of the pack at which its BMS ends a discharge [V]",
        f"voltage of the pack at which its BMS ends a discharge, which is 0 % [V]; {NONE}: that of the cell file",
        lambda text, answers: (
            None if text == NONE else _parse_limit_v("cutoff_voltage_v", text, answers, above_middle=False)
        ),
        lambda answers: _suggest_limit_v(answers, 1),
        explanation="This is 0 %: see the settings of the BMS.",
        hint="empty: usual for the chemistry",
    ),
    Question(
        "max_discharge_a",
        "Largest discharge current of the pack by its rating or its BMS [A]",
        f"largest discharge current of the pack [A]; {NONE}: unknown",
        lambda text, _: None if text == NONE else _validated(PackSettings, "max_discharge_a", parse_number(text, "A")),
        lambda _: NONE,
    ),
    Question(
        "max_charge_a",
        "Largest charge current of the pack by its rating or its BMS [A]",
        f"largest charge current of the pack [A]; {NONE}: unknown",
        lambda text, _: None if text == NONE else _validated(PackSettings, "max_charge_a", parse_number(text, "A")),
        lambda _: NONE,
    ),
    Question(
        "device_soc_std",
        "How far may the SOC of the device be wrong [%]",
        f"standard deviation of the SOC that the device reports, from which the estimate starts [%]; {NONE}: it is not used",
        lambda text, _: (
            None if text == NONE else _validated(PackSettings, "device_soc_std", parse_number(text, "%") / 100.0)
        ),
        lambda answers: DEFAULT_DEVICE_SOC_STD if _reports_soc(answers) else NONE,
        explanation="The estimate starts from this SOC, with the error that you give as its standard deviation.",
        is_asked=_reports_soc,
    ),
    Question(
        "broker",
        "MQTT broker to publish to",
        f"URL of the MQTT broker to which the service publishes, {ADDRESS_FORM}; {NONE}: no broker",
        _parse_broker,
        _suggest_broker,
    ),
)
"""Questions in their order."""
