#include "relay.h"

#include <avr/io.h>

#include "protocol.h"

#define PIN _BV(4)  // D4 is PD4, which timers, interrupts and the serial line do not use
#define US_PER_S 1000000UL

static uint32_t number;
static uint8_t when_silent;
static uint16_t seconds_left;
static uint32_t second_us;  // begin of the present second of silence
static bool second_begun;

static void drive(bool high) {
    if (high)
        PORTD |= PIN;
    else
        PORTD &= ~PIN;
}

void relay_start() {
    number = 0;
    when_silent = RELAY_KEEP;
    drive(false);
    DDRD |= PIN;
}

bool relay_set(uint32_t wanted) {
    const uint8_t level = (uint8_t)wanted, then = (uint8_t)(wanted >> 8);
    const uint16_t silent_s = (uint16_t)(wanted >> 16);
    if (level > 1 || then > RELAY_HIGH || silent_s > RELAY_SILENT_MAX_S || (then != RELAY_KEEP && silent_s == 0)) return false;
    number = wanted;
    when_silent = then;
    seconds_left = silent_s;
    second_begun = false;
    drive(level);
    return true;
}

uint32_t relay_get() { return number; }

void relay_see(uint32_t board_us) {
    if (when_silent == RELAY_KEEP) return;
    if (!second_begun) {
        second_begun = true;
        second_us = board_us;
    }
    while (board_us - second_us >= US_PER_S && seconds_left) {
        second_us += US_PER_S;
        seconds_left--;
    }
    if (seconds_left) return;
    drive(when_silent == RELAY_HIGH);
    when_silent = RELAY_KEEP;
}
