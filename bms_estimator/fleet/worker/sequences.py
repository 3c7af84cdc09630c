"""Which message of a stream it is that a consumer gives. Pure."""


def sequences(reply: str) -> tuple[int, int]:
    """A message's number in its stream, and that of the consumer, which has no holes.

    Args:
        reply: Where it would be acknowledged (ADR-15): 9 tokens, or 11 and more with the server's domain.
    """
    tokens = reply.split(".")
    first = 5 if len(tokens) == 9 else 7
    return int(tokens[first]), int(tokens[first + 1])
