#include "sampling.h"

#include <avr/cpufunc.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>
#include <util/atomic.h>
#include <util/delay.h>

#define FULL_SCALE_READING 1023
#define MUX_AVCC _BV(REFS0)
#define MUX_VOLTAGE (MUX_AVCC | 0)
#define MUX_CURRENT (MUX_AVCC | 1)
#define MUX_NTC (MUX_AVCC | 2)
#define MUX_BANDGAP (MUX_AVCC | 14)

#define PRESCALER_128 (_BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0))
#define TRIGGER_TIMER1_COMPARE_B (_BV(ADTS2) | _BV(ADTS0))

#define BOOT_READINGS 256
#define NTC_OPEN_READING 1015  // with the pull-up on; an NTC at -40 degC gives 999

// Count at which timer 1 triggers a conversion, once a slot of any length. The chip would accept 0. simavr needs some
// instructions between the wrap of the counter and the trigger.
#define TRIGGER_AT 16

// Range of the count in which the CPU may go to sleep. A conversion ends 1728 cycles after its trigger.
#define SLEEP_FROM_CYCLES 64
#define SLEEP_UNTIL_CYCLES 1500

static sample_message windows[2];
static uint8_t filling;              // index of the window being summed; only the interrupt changes it
static volatile bool window_waits;   // true: the other window has ended and is not released

static window_timing timing, next_timing;
static volatile bool timing_changed;

static uint32_t next_sequence, elapsed_us;
static uint8_t elapsed_cycles;       // remainder of elapsed_us, below 16

static bool ntc_fitted;
static uint16_t slots_left;
static uint8_t aux_countdown, aux_mux = MUX_BANDGAP;
static bool aux_now;
static uint8_t mux;                  // input of the running conversion

static void begin_window(sample_message *w, uint8_t status) {
    w->voltage_sum = w->current_sum = 0;
    w->count = w->aux_sum = 0;
    w->aux_count = 0;
    w->status = status;
    slots_left = timing.slots;
    aux_now = --aux_countdown == 0;
    if (aux_now) aux_countdown = timing.aux_windows;
}

// The counter may already be beyond the new top. In CTC mode it would then count to 65535: "If the new value written to
// OCR1A is lower than the current value of TCNT1, the counter will miss the compare match" (data sheet, 15.9.2). In fast
// PWM, OCR1A is double buffered and changes when the counter wraps (15.9.3). Therefore the running slot keeps its length,
// and the slots of the new window have the new length.
static void apply_timing() {
    timing = next_timing;
    timing_changed = false;
    aux_countdown = 1;
    OCR1A = timing.slot_cycles - 1;
}

static void end_window(sample_message *w) {
    const uint32_t cycles = period_cycles(&timing) + elapsed_cycles;
    elapsed_us += cycles >> 4;
    elapsed_cycles = cycles & 15;
    w->sequence = next_sequence++;
    w->board_us = elapsed_us;
    uint8_t status = 0;
    if (window_waits) {
        status = STATUS_OVERRUN;  // this window is lost, and its memory is reused
    } else {
        window_waits = true;
        filling ^= 1;
    }
    if (timing_changed) apply_timing();
    begin_window(&windows[filling], status);
}

static inline bool aux_is_next() {
    const uint8_t aux_slots = timing.aux_readings + AUX_SETTLING_SLOTS;
    return aux_now && slots_left != 0 && slots_left <= aux_slots;
}

static inline void take_aux(sample_message *w, uint16_t reading) {
    if (slots_left >= timing.aux_readings) return;  // not settled yet
    w->aux_sum += reading;
    w->aux_count++;
    if (slots_left != 0) return;
    if (aux_mux == MUX_NTC) w->status |= STATUS_AUX_IS_NTC;
    if (ntc_fitted) aux_mux = aux_mux == MUX_NTC ? MUX_BANDGAP : MUX_NTC;
}

// The next trigger comes 270 cycles after the end of a conversion. Before it, the input must be switched and the trigger
// armed. Every other interrupt, and every section with interrupts disabled, must be shorter than that.
ISR(ADC_vect) {
    const uint16_t reading = ADC;
    sample_message *w = &windows[filling];
    slots_left--;
    if (mux == MUX_VOLTAGE) {
        mux = MUX_CURRENT;
        ADMUX = MUX_CURRENT;
        TIFR1 = _BV(OCF1B);  // the converter starts when this flag rises
        w->voltage_sum += reading;
        if (reading == FULL_SCALE_READING) w->status |= STATUS_VOLTAGE_SATURATED;
        return;
    }
    const bool was_current = mux == MUX_CURRENT;
    mux = aux_is_next() ? aux_mux : MUX_VOLTAGE;
    ADMUX = mux;
    TIFR1 = _BV(OCF1B);
    if (was_current) {
        w->current_sum += reading;
        w->count++;
        if (reading == FULL_SCALE_READING || reading == 0) w->status |= STATUS_CURRENT_SATURATED;
    } else {
        take_aux(w, reading);
    }
    if (slots_left == 0) end_window(w);
}

static uint16_t convert_now() {
    ADCSRA |= _BV(ADSC);
    while (ADCSRA & _BV(ADSC)) {
    }
    return ADC;
}

boot_readings sampling_measure_at_boot() {
    boot_readings boot;
    DIDR0 = _BV(ADC0D) | _BV(ADC1D) | _BV(ADC2D);
    ADCSRB = 0;
    ADCSRA = _BV(ADEN) | PRESCALER_128;

    ADMUX = MUX_NTC;
    PORTC |= _BV(PORTC2);  // an open input floats; the pull-up sets it to the upper end
    _delay_ms(1);
    convert_now();
    boot.ntc_fitted = convert_now() < NTC_OPEN_READING;
    PORTC &= ~_BV(PORTC2);

    ADMUX = MUX_BANDGAP;
    _delay_ms(2);
    convert_now();
    boot.bandgap_sum = 0;
    boot.bandgap_count = BOOT_READINGS;
    for (uint16_t i = 0; i < BOOT_READINGS; i++) boot.bandgap_sum += convert_now();
    return boot;
}

void sampling_start(bool fitted) {
    ntc_fitted = fitted;
    next_timing = timing_of(RATE_DEFAULT_HZ);
    TCCR1A = 0;
    TCCR1B = 0;
    TCNT1 = 0;
    OCR1B = TRIGGER_AT;
    apply_timing();
    begin_window(&windows[filling], 0);
    mux = MUX_VOLTAGE;
    ADMUX = mux;
    ADCSRB = TRIGGER_TIMER1_COMPARE_B;
    ADCSRA = _BV(ADEN) | _BV(ADATE) | _BV(ADIF) | _BV(ADIE) | PRESCALER_128;
    TIFR1 = _BV(OCF1B);
    TCCR1A = _BV(WGM11) | _BV(WGM10);
    TCCR1B = _BV(WGM13) | _BV(WGM12) | _BV(CS10);  // fast PWM without a pin: counts CPU clocks up to OCR1A
}

void sampling_set_timing(const window_timing &wanted) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        next_timing = wanted;
        timing_changed = true;
    }
}

const window_timing &sampling_timing() { return next_timing; }

sample_message *sampling_window() {
    if (!window_waits) return nullptr;
    _MemoryBarrier();  // the window must not be read before the flag
    return &windows[filling ^ 1];
}

void sampling_release() {
    _MemoryBarrier();
    window_waits = false;
}

void sampling_sleep() {
    cli();
    const uint16_t cycles = TCNT1;
    if (!window_waits && cycles > SLEEP_FROM_CYCLES && cycles < SLEEP_UNTIL_CYCLES) {
        set_sleep_mode(SLEEP_MODE_IDLE);
        sleep_enable();
        sei();
        sleep_cpu();
        sleep_disable();
    }
    sei();
}
