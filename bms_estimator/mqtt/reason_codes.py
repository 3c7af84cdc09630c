"""Descriptions of MQTT 5 reason codes. paho translates the return codes of MQTT 3.1.1 to them."""

from paho.mqtt.reasoncodes import ReasonCode

UNSUPPORTED_VERSION = 132
"""CONNACK code of a broker without MQTT 5."""

_NOT_ALLOWED = (
    "name or password wrong, or not allowed; "
    "see {section}.username, {section}.password_file and the broker's access list"
)
HINTS = {
    133: "another mqtt.base_topic or pack.name may help",  # client identifier not valid
    134: _NOT_ALLOWED,  # bad user name or password
    135: _NOT_ALLOWED,  # not authorized
    136: "the broker is not ready",  # server unavailable
    138: "the broker does not want this client",  # banned
    141: "it received nothing from this client for too long",  # keep alive timeout
    142: "another client has the same name",  # session taken over
    149: "a message is longer than the broker takes",  # packet too large
    151: "the broker allows no more",  # quota exceeded
    159: "too many connections in a short time",  # connection rate exceeded
}
"""Causes and remedies by reason code. ``section`` is the settings section of the broker."""

LOGIN = {134, 135}
"""Reason codes of a rejected connection with a wrong or missing user name or password."""

FINAL = {
    135,  # not authorized
    144,  # topic name invalid
    149,  # packet too large
    153,  # payload format invalid
}
"""Reason codes of permanent rejections. All other codes (busy, quota, unspecified) may be temporary."""


def is_final(reason: ReasonCode) -> bool:
    """Return True if a message with this reason will always be rejected."""
    return reason.value in FINAL


def describe_reason(reason: ReasonCode, section: str) -> str:
    """Return a reason code as text: name, number, hint.

    Args:
        reason: Reason code.
        section: Settings section of the broker.
    """
    hint = HINTS.get(reason.value, "").format(section=section)
    return f"{reason.getName()} ({reason.value})" + (f": {hint}" if hint else "")
