"""One hour of a battery's load, as histories that contain the values of a device only when they change."""

import json
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta, timezone
from typing import NamedTuple

VOLTAGE, CURRENT, MODE = "sensor.bank_total_voltage", "sensor.bank_current", "select.inverter_mode"
START_S = 1_770_000_000.0
"""Unix time of the first value [s]."""
PERIOD_S = 5.0
"""Period at which the device measures [s]."""
SKEW_S = 1.4
"""Time from the voltage to the current of one measurement [s]."""
UNAVAILABLE_S = (1800.0, 1820.0)
"""Times since the start at which the current becomes unavailable, and available again [s]."""
CHARGE_AH = 21.0
"""Charge of 18 and 24 A in turn for 10 min each, for an hour."""


class Change(NamedTuple):
    """New state of an entity."""

    entity: str
    state: str
    time_s: float


def load_a(second: float) -> float:
    """Return the current, positive on discharge [A]."""
    return 24.0 if second // 600.0 % 2 else 18.0


def changes(unavailable_s: tuple[float, float] = UNAVAILABLE_S) -> list[Change]:
    """Return the changes of all entities in the order of time. The current is negative on discharge."""
    found, last = [Change(MODE, "Discharging", START_S)], dict[str, str]()
    for index in range(721):
        second = PERIOD_S * index
        noise_v = 0.01 * (index * 7 % 3)
        voltage = f"{53.0 - 0.02 * load_a(second) + noise_v:.2f}"
        is_available = not unavailable_s[0] <= second < unavailable_s[1]
        current = f"{-load_a(second):.1f}" if is_available else "unavailable"
        for entity, state, skew_s in ((VOLTAGE, voltage, 0.0), (CURRENT, current, SKEW_S)):
            if last.get(entity) != state:
                last[entity] = state
                found.append(Change(entity, state, START_S + second + skew_s))
    return found


def iso(time_s: float, hours: int = 0) -> str:
    """Return a time as ISO 8601 in the time zone of an offset from UTC."""
    zone = timezone(timedelta(hours=hours)) if hours else UTC
    return datetime.fromtimestamp(time_s, zone).isoformat(timespec="milliseconds")


def home_assistant_csv(rows: Iterable[Change]) -> str:
    """Return the CSV that the history page of Home Assistant exports."""
    lines = [f"{row.entity},{row.state},{iso(row.time_s).replace('+00:00', 'Z')}" for row in rows]
    return "\n".join(["entity_id,state,last_changed", *lines]) + "\n"


def quoted_csv(rows: Iterable[Change]) -> str:
    """Return a CSV with a byte order mark, semicolons, quotes, another time zone, and two times of which the later one counts."""
    lines = [f'"{iso(row.time_s, 2)}";"{iso(START_S)}";"{row.state}";"{row.entity}"' for row in rows]
    return "\n".join(['\ufeff"last_updated";"last_changed";"state";"entity_id"', *lines]) + "\n"


def unix_csv(rows: Iterable[Change]) -> str:
    """Return a CSV with Unix times in milliseconds."""
    lines = [f"{row.state},{1e3 * row.time_s:.0f},{row.entity}" for row in rows]
    return "\n".join(["state,last_changed,entity_id", *lines]) + "\n"


def unsorted_csv(rows: Iterable[Change]) -> str:
    """Return a CSV with the latest change first, and an outdated value before each value at the same time."""
    twice = [each for row in rows for each in (row, row._replace(state="12.3" if row.entity == VOLTAGE else row.state))]
    return home_assistant_csv(reversed(twice))


def histories(rows: Iterable[Change]) -> dict[str, list[Change]]:
    """Return the changes of each entity."""
    found = dict[str, list[Change]]()
    for row in rows:
        found.setdefault(row.entity, []).append(row)
    return found


def unit(entity: str) -> dict[str, str]:
    """Return the attributes of an entity."""
    units = {VOLTAGE: "V", CURRENT: "A"}
    return {"unit_of_measurement": units[entity]} if entity in units else {}


def json_period(rows: Iterable[Change]) -> str:
    """Return the response of /api/history/period."""
    return json.dumps(
        [
            [
                {
                    "entity_id": row.entity,
                    "state": row.state,
                    "attributes": unit(row.entity),
                    "last_changed": iso(row.time_s),
                    "last_updated": iso(row.time_s),
                }
                for row in history
            ]
            for history in histories(rows).values()
        ],
        indent=2,
    )


def json_minimal(rows: Iterable[Change]) -> str:
    """Return the response of /api/history/period with ``minimal_response``: only the first and last record are complete."""
    complete = json.loads(json_period(rows))
    for history in complete:
        history[1:-1] = [{name: record[name] for name in ("state", "last_changed")} for record in history[1:-1]]
    return json.dumps(complete)


def json_compressed(rows: Iterable[Change]) -> str:
    """Return the result of the WebSocket command history/history_during_period."""
    return json.dumps(
        {
            entity: [
                {"s": row.state, "a": unit(entity) if row is history[0] else {}, "lu": row.time_s} for row in history
            ]
            for entity, history in histories(rows).items()
        }
    )


def numbers(rows: Iterable[Change]) -> dict[str, list[Change]]:
    """Return the changes of each entity with numbers only, as Home Assistant writes them to InfluxDB."""
    return histories(row for row in rows if row.state[-1].isdigit())


def influx_2_of_home_assistant(rows: Iterable[Change]) -> str:
    """Return annotated CSV of InfluxDB 2 with a table for each entity. The measurement is the unit."""
    text = ""
    for table, (entity, history) in enumerate(numbers(rows).items()):
        text += "#group,false,false,false,false,true,true,true,true\r\n#datatype,string,long,dateTime:RFC3339,double,string,string,string,string\r\n#default,_result,,,,,,,\r\n"
        text += ",result,table,_time,_value,_field,_measurement,domain,entity_id\r\n"
        measurement, (domain, name) = unit(entity)["unit_of_measurement"], entity.split(".")
        for row in history:
            text += f",,{table},{iso(row.time_s)},{row.state},value,{measurement},{domain},{name}\r\n"
        text += "\r\n"
    return text


def influx_2_fields(rows: Iterable[Change]) -> str:
    """Return CSV of InfluxDB 2 with voltage and current as fields of one measurement."""
    fields = {VOLTAGE: "bus_voltage", CURRENT: "current"}
    lines = [
        f",_result,{table},{iso(row.time_s)},{row.state},{fields[entity]},battery"
        for table, (entity, history) in enumerate(numbers(rows).items())
        for row in history
    ]
    return "\n".join([",result,table,_time,_value,_field,_measurement", *lines]) + "\n"


def influx_1(rows: Iterable[Change]) -> str:
    """Return CSV of InfluxDB 1 with a table for each measurement, in nanoseconds."""
    text = ""
    for entity, history in numbers(rows).items():
        text += "name,tags,time,value\n"
        for row in history:
            text += f'{unit(entity)["unit_of_measurement"]},"domain=sensor,entity_id={entity[7:]}",{row.time_s * 1e9:.0f},{row.state}\n'
        text += "\n"
    return text


def grafana(rows: Iterable[Change]) -> str:
    """Return CSV of Grafana with the series as rows."""
    lines = [
        f'"{entity[7:]}";"{iso(row.time_s)}";{row.state}' for entity, each in numbers(rows).items() for row in each
    ]
    return "\n".join(['"Series";"Time";"Value"', *lines]) + "\n"


EXPORTS = (
    home_assistant_csv,
    quoted_csv,
    unix_csv,
    unsorted_csv,
    json_period,
    json_minimal,
    json_compressed,
    influx_2_of_home_assistant,
    influx_2_fields,
    influx_1,
    grafana,
)
