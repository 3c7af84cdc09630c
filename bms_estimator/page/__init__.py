"""The live page: what packs publish, in a browser.

``PackTopics`` holds the newest payload of each topic, ``server`` hands them on as server-sent events. The hub is
filled by one of two feeds: the sink of a service (``sink``), or a subscriber of a broker (``feed``).
"""
