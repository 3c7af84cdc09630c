"""Payloads over MQTT: topics, messages, requests, availability."""
