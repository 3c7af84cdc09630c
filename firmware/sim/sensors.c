#include "sensors.h"

#include <math.h>
#include <stdio.h>
#include <simavr/avr_adc.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_io.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#include "readings.h"

#define DIVIDER 6.1
#define PART_PER_AMPERE (0.1 / 5.0)  // fraction of the supply
#define BANDGAP_V 1.1
#define NTC_SERIES_OHM 10e3
#define NTC_R25_OHM 10e3
#define NTC_BETA_K 3950.0

enum { PIN_VOLTAGE = 0, PIN_CURRENT = 1, PIN_NTC = 2, PIN_BANDGAP = 7 };  // an Uno has no pin for the last one
#define MUX_BANDGAP 14

#define FULL_SCALE 1024.0
#define SIMAVR_FULL_SCALE 0x3FF

#define TCCR1A_ADDRESS 0x80
#define TCCR1B_ADDRESS 0x81
#define OCR1A_ADDRESS 0x88
#define WGM1_HIGH_BITS 0x18
#define WGM1_CTC 0x08
#define WGM1_LOW_BITS 0x03
#define TIFR1_ADDRESS 0x36
#define OCF1B_BIT 2
#define TIMER1_COMPB_VECTOR 12

#define DDRD_ADDRESS 0x2A
#define PORTD_ADDRESS 0x2B
#define RELAY_PIN 0x10  // D4

static avr_t *board;
static converter parts;
static bool trigger_armed = true;
static avr_cycle_count_t last_compare;  // compare match with OCR1B, a few cycles after the counter's zero

static double uniform(void) {  // xorshift64*, in (0, 1)
    parts.seed ^= parts.seed >> 12;
    parts.seed ^= parts.seed << 25;
    parts.seed ^= parts.seed >> 27;
    return ((double)((parts.seed * 2685821657736338717ULL) >> 11) + 0.5) / 9007199254740992.0;
}

static double noise(void) {  // Box and Muller
    return parts.noise_lsb * sqrt(-2.0 * log(uniform())) * cos(2.0 * M_PI * uniform());
}

static bool load_is_cut(void) {
    return parts.relay && (board->data[DDRD_ADDRESS] & board->data[PORTD_ADDRESS] & RELAY_PIN);
}

static double pin_v(unsigned pin) {
    const reading *r = readings_at((double)board->cycle / (double)board->frequency);
    switch (pin) {
        case PIN_VOLTAGE: return r->voltage_v / DIVIDER;
        case PIN_CURRENT: return parts.avcc_v * (0.5 + (load_is_cut() ? 0.0 : r->current_a) * PART_PER_AMPERE);
        case PIN_BANDGAP: return BANDGAP_V;
        case PIN_NTC:
            if (!isnan(r->temperature_c)) {
                const double kelvin = r->temperature_c + 273.15;
                const double r_ohm = NTC_R25_OHM * exp(NTC_BETA_K * (1.0 / kelvin - 1.0 / 298.15));
                return parts.avcc_v * r_ohm / (r_ohm + NTC_SERIES_OHM);
            }
            return parts.avcc_v;
        default: return 0.0;
    }
}

// simavr accepts whole millivolts only and counts 1023 steps. Therefore the conversion is computed here, with noise and
// the 1024 steps of the data sheet, and passed on as the millivolts that simavr converts to the same number.
static void convert(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    union {
        uint32_t value;
        avr_adc_mux_t mux;
    } started = {.value = value};
    const double steps = rint(pin_v(started.mux.src) / parts.avcc_v * FULL_SCALE + noise());
    const uint32_t code = steps < 0.0 ? 0 : steps > SIMAVR_FULL_SCALE ? SIMAVR_FULL_SCALE : (uint32_t)steps;
    const uint32_t millivolts = (code * board->avcc + SIMAVR_FULL_SCALE - 1) / SIMAVR_FULL_SCALE;
    avr_raise_irq((avr_irq_t *)param + started.mux.src, millivolts);
}

// Triggers the converter by the timer, which simavr does not. As on the chip, the flag must be cleared before the next one.
static void compare_b(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    if (!value) return;
    last_compare = board->cycle;
    if (!trigger_armed) return;
    trigger_armed = false;
    avr_raise_irq((avr_irq_t *)param, 1);
}

static void write_tifr1(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)param;
    if (value & (1 << OCF1B_BIT)) trigger_armed = true;
}

// simavr accepts a new top at any count. The chip does not in CTC mode, which has no double buffering: a counter beyond
// the new top counts to 65535, and 4 ms are missing in the samples.
static void write_top(struct avr_irq_t *irq, uint32_t value, void *param) {
    (void)irq;
    (void)value;
    (void)param;
    const bool ctc = (board->data[TCCR1B_ADDRESS] & WGM1_HIGH_BITS) == WGM1_CTC &&
                     (board->data[TCCR1A_ADDRESS] & WGM1_LOW_BITS) == 0;
    const unsigned top = board->data[OCR1A_ADDRESS] | board->data[OCR1A_ADDRESS + 1] << 8;
    if (!ctc || board->cycle - last_compare <= top) return;
    fprintf(stderr, "OCR1A was set to %u when timer 1 stood at %u: the compare is missed\n", top,
            (unsigned)(board->cycle - last_compare));
    exit(1);
}

// The bandgap becomes a pin, so that it has noise as well.
static void make_bandgap_a_pin(void) {
    for (avr_io_t *io = board->io_port; io; io = io->next)
        if (strcmp(io->kind, "adc") == 0)
            ((avr_adc_t *)io)->muxmode[MUX_BANDGAP] = (avr_adc_mux_t)AVR_ADC_SINGLE(PIN_BANDGAP);
}

void sensors_attach(avr_t *avr, const converter *c) {
    board = avr;
    parts = *c;
    avr->vcc = avr->avcc = avr->aref = (uint32_t)lround(parts.avcc_v * 1e3);
    make_bandgap_a_pin();
    avr_irq_t *pins = avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, 0);
    avr_irq_register_notify(pins + ADC_IRQ_OUT_TRIGGER, convert, pins);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, TIMER1_COMPB_VECTOR) + AVR_INT_IRQ_PENDING, compare_b,
                            pins + ADC_IRQ_IN_TRIGGER);
    avr_irq_register_notify(avr_iomem_getirq(avr, OCR1A_ADDRESS, "ocr1a", AVR_IOMEM_IRQ_ALL), write_top, NULL);
    avr_irq_register_notify(avr_iomem_getirq(avr, TIFR1_ADDRESS, "tifr1", AVR_IOMEM_IRQ_ALL), write_tifr1, NULL);
}
