"""Web page of the fleet."""
