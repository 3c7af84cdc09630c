// Voltage (A0), current (A1) and temperature (A2) of a battery pack, for an ATmega328P at 16 MHz: Uno, Nano.
// Timer 1 triggers the converter, whose interrupt sums the conversions. The loop sends them as PROTOCOL.md specifies.

#ifndef __AVR_ATmega328P__
#error "This firmware is for an ATmega328P at 16 MHz: choose Arduino Uno or Nano as the board."
#endif

#include <avr/interrupt.h>
#include <avr/io.h>

#include "commands.h"
#include "line.h"
#include "protocol.h"
#include "relay.h"
#include "reset.h"
#include "sampling.h"
#include "settings.h"

static bool overrun;

void setup() {
    relay_start();
    TIMSK0 = 0;  // millis() is not used, and its interrupt would delay the others
    reset_start_watchdog();
    settings_load();
    line_start();
    const boot_readings boot = sampling_measure_at_boot();
    sampling_start(boot.ntc_fitted);
    commands_start(boot);  // long before the first window ends
}

static void send(sample_message *sample) {
    uint8_t packet[SAMPLE_BYTES];
    sample->status |= (uint8_t)(reset_cause() << 4);
    if (overrun) sample->status |= STATUS_OVERRUN;
    overrun = !line_send(packet, encode_sample(packet, sample));
}

void loop() {
    reset_feed_watchdog();
    sample_message *sample = sampling_window();
    if (sample) {
        commands_see(*sample);
        send(sample);
        sampling_release();
    }
    commands_poll();
    settings_write_on();
    sampling_sleep();
}
