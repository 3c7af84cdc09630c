"""Topics that the broker denies."""

import structlog

from bms_estimator.sinks import Delivery

log = structlog.get_logger(__name__)


def name_refused(delivery: Delivery, topic: str, why: str) -> None:
    """Name a topic in log and health, once for each connection."""
    if topic not in delivery.refused_topics:
        delivery.refused_topics.append(topic)
        log.warning("broker refuses a topic; see its access list", topic=topic, reason=why)
