"""Why the server does not do what it is asked for, in words that say what to do."""

import nats.errors
import nats.js.errors

_REASONS: dict[type[BaseException], str] = {
    nats.js.errors.NotFoundError: "the server lacks one of the streams: make them with `bms-estimator fleet serve`",
    nats.js.errors.NoStreamResponseError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.errors.NoRespondersError: "no node leads the stream now, or the server keeps no streams for this account",
    nats.js.errors.ServiceUnavailableError: "the server's streams are not available now",
    nats.js.errors.APIError: "the server refuses",
    nats.errors.AuthorizationError: "the server refuses these credentials: look at --creds",
    TimeoutError: "no answer in time: are most nodes up, and is it the port for workers (4222)?",  # that of NATS is one, too
    ConnectionRefusedError: "nobody listens there",
}
"""The first that an error is one of."""
_WORDS = {
    "authorization violation": "the server refuses these credentials, or asks for some: look at --creds",
    "permissions violation": "these credentials may not do that: look at --creds",
    "certificate_verify_failed": "its certificate is of nobody whom we trust, or names another server: look at --ca",
}
"""What the library says in words alone."""


def reason(error: BaseException) -> str:
    """Of an error of NATS, or of the line to it."""
    said = str(getattr(error, "description", None) or error).removeprefix("nats: ") or type(error).__name__
    for kind, text in _REASONS.items():
        if isinstance(error, kind):
            return f"{text} ({said})" if isinstance(error, nats.js.errors.APIError) else text
    for words, text in _WORDS.items():
        if words in said.lower():
            return f"{text} ({said})"
    return said
