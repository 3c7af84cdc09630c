"""One line for each message of a pack, for a file or a pipe. Pure."""

from bms_estimator.mqtt.topic_cache import DeviceMessage
from bms_estimator.sinks.terminal.json_fields import JsonFields
from bms_estimator.sinks.terminal.panels import band_text
from bms_estimator.sinks.terminal.scene import ALARM


def line(heard: DeviceMessage, true_soc: float | None = None) -> str | None:
    """One line; None for messages of no interest.

    Args:
        heard: A message of a pack.
        true_soc: SOC 0..1 of a simulated pack.
    """
    fields = JsonFields(heard.payload)
    if heard.topic == "state" and fields:
        return _state(heard.device, fields, true_soc)
    if heard.topic == "health" and fields and not fields.flag("sensor_online"):
        return f"{fields.text('publish_time')} {heard.device}: {fields.text('sensor_message') or 'no sample'}"
    if heard.topic.startswith(ALARM) and fields.flag("active"):
        return f"{fields.text('since')} {heard.device}: alarm, {fields.text('severity')}: {fields.text('text')}"
    return None


def _state(device: str, e: JsonFields, true_soc: float | None) -> str:
    def number(name: str, form: str, factor: float = 1.0) -> str:
        value = e.number(name)
        return "-" if value is None else f"{value * factor:{form}}"

    gain = f"N {number('nussbaum_gain', '.4f')}"
    if e.number("adaptation_gain_hz") is not None:
        gain = f"gamma k {number('adaptation_gain_hz', '.4f')}/s"
    truth = "" if true_soc is None else f"  true {100.0 * true_soc:.2f} %"
    return (
        f"{e.text('time')} {device}: soc {number('soc_percent', '.2f')}{band_text(e)} %{truth}  "
        f"{number('voltage_v', '.3f')} V  {number('current_a', '+.3f')} A  {number('power_w', '+.2f')} W  "
        f"margin {number('stability_margin', '.4f')}  "
        f"delta1 {number('delta_1', '.4f')}  delta2 {number('delta_2', '.4f')}  "
        f"{gain}  k {number('adaptive_gain_k', '.3g')}  "
        f"innovation {number('innovation_v', '+.2f', 1e3)} mV  {'lock' if e.flag('lock') else 'NO LOCK'}  "
        f"{'converged' if e.flag('converged') else 'converging'}  "
        f"frames {e.count('frames_received')}  lost {e.count('frames_lost')}"
    )
