"""One line of text for each message of a pack, for a file or a pipe. No I/O."""

from bms_estimator.mqtt.topic_cache import DeviceMessage
from bms_estimator.sinks.terminal.json_fields import JsonFields
from bms_estimator.sinks.terminal.view_state import ALARM_PREFIX, NOT_KNOWN, soc_text
from bms_estimator.telemetry.cutoff_text import CUTOFF_FIELDS, cutoff_text


def text_line(message: DeviceMessage, true_soc: float | None = None) -> str | None:
    """Return one line; None for a message that is not printed.

    Args:
        message: A message of a pack.
        true_soc: SOC 0..1 of a simulated pack.
    """
    fields = JsonFields(message.payload)
    if message.topic == "state" and fields:
        return _state_line(message.device, fields, true_soc)
    if message.topic == "health" and fields and not fields.flag("sensor_online"):
        return f"{fields.text('publish_time')} {message.device}: {fields.text('sensor_message') or 'no sample'}"
    if message.topic.startswith(ALARM_PREFIX) and fields.flag("active"):
        return f"{fields.text('since')} {message.device}: alarm, {fields.text('severity')}: {fields.text('text')}"
    return None


def _state_line(device: str, state: JsonFields, true_soc: float | None) -> str:
    number = state.number_text
    gain = f"N {number('nussbaum_gain', '.4f')}"
    if state.number("adaptation_gain_hz") is not None:
        gain = f"gamma k {number('adaptation_gain_hz', '.4f')}/s"
    cutoff = cutoff_text(*(state.number(name) for name in CUTOFF_FIELDS)) or "-"
    soc = soc_text(state)
    truth = "" if true_soc is None else f"  true {100.0 * true_soc:.2f} %"
    return (
        f"{state.text('time')} {device}: soc {soc}{'' if soc == NOT_KNOWN else ' %'}{truth}  "
        f"{number('voltage_v', '.3f')} V  {number('current_a', '+.3f')} A  {number('power_w', '+.2f')} W  "
        f"to cut-off {cutoff}  margin {number('stability_margin', '.4f')}  "
        f"delta1 {number('delta_1', '.4f')}  delta2 {number('delta_2', '.4f')}  "
        f"innovation {number('innovation_v', '+.2f', 1e3)} mV  observer {'in' if state.flag('lock') else 'OUT OF'} lock, "
        f"{'converged' if state.flag('converged') else 'converging'}, e {number('tracking_error_v', '+.2f', 1e3)} mV  "
        f"{gain}  k {number('adaptive_gain_k', '.3g')}  "
        f"frames {state.count('frames_received')}  lost {state.count('frames_lost')}"
    )
