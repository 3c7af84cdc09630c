"""Sources of samples: serial ports, field buses, MQTT, Linux sensors, Bluetooth, captures."""
