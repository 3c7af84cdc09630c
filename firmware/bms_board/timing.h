// Division of the converter's clock into samples. The tests compile it on the host.
#ifndef BMS_BOARD_TIMING_H
#define BMS_BOARD_TIMING_H

#include <stdint.h>

#define CLOCK_HZ 16000000UL
#define SLOTS_PER_S 8000UL  // conversions, 125 us each: one takes 13.5 clocks of 8 us
#define AUX_PER_S 100       // readings of bandgap or NTC
#define AUX_MAX 63          // readings in a window, because their sum has 16 bits

// Slots before the readings that count. The bandgap has a high output impedance: it takes about 350 us to charge the
// converter's capacitor.
#define AUX_SETTLING_SLOTS 3

// A slot is the time from one trigger of the converter to the next.
typedef struct {
    uint16_t rate_hz;
    uint16_t slots;        // in a window; even, because A0 and A1 alternate
    uint16_t slot_cycles;  // CPU clocks in a slot
    uint8_t aux_windows;   // windows from one with aux readings to the next
    uint8_t aux_readings;  // at the end of such a window; odd, so that with the settling slots their number is even
} window_timing;

// Returns the timing of a sample rate. Slots are lengthened by whole clocks to fill the window.
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
