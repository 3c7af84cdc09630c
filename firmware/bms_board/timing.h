// How the converter's clock is divided into samples. Also compiled on the host by the tests.
#ifndef BMS_BOARD_TIMING_H
#define BMS_BOARD_TIMING_H

#include <stdint.h>

#define CLOCK_HZ 16000000UL
#define SLOTS_PER_S 8000UL  // conversions, 125 us each: one takes 13.5 clocks of 8 us
#define AUX_PER_S 100       // readings of bandgap or NTC
#define AUX_MAX 63          // in a window: their sum has 16 bits

// The bandgap's source is weak: it takes some 350 us to charge the converter's capacitor. So much is given to it before
// the readings that count.
#define AUX_SETTLING_SLOTS 3

// A slot is the time from one trigger of the converter to the next.
typedef struct {
    uint16_t rate_hz;
    uint16_t slots;        // in a sample's window, even: A0 and A1 by turns
    uint16_t slot_cycles;  // CPU clocks in a slot
    uint8_t aux_windows;   // windows from one with aux readings to the next
    uint8_t aux_readings;  // in such a window, at its end; odd, so that with what settles they take whole pairs
} window_timing;

// The slots that fit, stretched by whole clocks until they fill the window.
static inline window_timing timing_of(uint16_t rate_hz) {
    window_timing t;
    t.rate_hz = rate_hz;
    t.slots = (uint16_t)(SLOTS_PER_S / rate_hz / 2 * 2);
    const uint32_t slots_per_s = (uint32_t)rate_hz * t.slots;
    t.slot_cycles = (uint16_t)((CLOCK_HZ + slots_per_s / 2) / slots_per_s);
    t.aux_windows = (uint8_t)(rate_hz > AUX_PER_S ? rate_hz / AUX_PER_S : 1);
    const uint16_t aux = AUX_PER_S / rate_hz;
    t.aux_readings = (uint8_t)(aux == 0 ? 1 : aux > AUX_MAX ? AUX_MAX : (aux - 1) | 1);
    return t;
}

static inline uint32_t period_cycles(const window_timing *t) { return (uint32_t)t->slots * t->slot_cycles; }

static inline uint32_t period_ns(const window_timing *t) { return period_cycles(t) * 125 / 2; }

#endif
