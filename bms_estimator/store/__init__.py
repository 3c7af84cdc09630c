"""What must not be lost: messages on their way to the broker, and the pack's history."""
