"""Live page of packs in a browser.

``PackTopics`` stores the newest payload of each topic, and ``web_server`` sends them as server-sent events. Payloads come
from the snapshots of a service (``page_sink``) or from a subscription at a broker (``broker_page``).
"""
