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

// Timer 1 triggers when it counts this: once a slot, however long the slot is. The chip would take 0 as well, simavr
// needs some instructions from the turn of the counter to it.
#define TRIGGER_AT 16

// A conversion ends 1728 cycles after its trigger; before that there is time to fall asleep.
#define SLEEP_FROM_CYCLES 64
#define SLEEP_UNTIL_CYCLES 1500

static sample_message windows[2];
static uint8_t filling;              // index of the window being summed up; the interrupt's own
static volatile bool window_waits;   // the other one has ended and is not released

static window_timing timing, next_timing;
static volatile bool timing_changed;

static uint32_t next_sequence, elapsed_us;
static uint8_t elapsed_cycles;       // beyond elapsed_us, below 16

static bool ntc_fitted;
static uint16_t slots_left;
static uint8_t aux_countdown, aux_mux = MUX_BANDGAP;
static bool aux_now;
static uint8_t mux;                  // of the conversion that runs

static void begin_window(sample_message *w, uint8_t status) {
    w->voltage_sum = w->current_sum = 0;
    w->count = w->aux_sum = 0;
    w->aux_count = 0;
    w->status = status;
    slots_left = timing.slots;
    aux_now = --aux_countdown == 0;
    if (aux_now) aux_countdown = timing.aux_windows;
}

// The counter may stand anywhere, also beyond the new top. In CTC mode it would go on to 65535 then: "If the new value
// written to OCR1A is lower than the current value of TCNT1, the counter will miss the compare match" (data sheet,
// 15.9.2). In fast PWM OCR1A is double buffered and changes where the counter turns (15.9.3): the slot that runs keeps
// its length, and those of the new window get theirs.
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
        status = STATUS_OVERRUN;  // this one is lost, and its place is used again
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

// There are 270 cycles from the end of a conversion to the next trigger: by then the input must be switched and the
// trigger armed. No interrupt and no locked section may last so long.
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
    PORTC |= _BV(PORTC2);  // an open input floats anywhere: the pull-up makes it an upper end
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
    _MemoryBarrier();  // nothing of the window is read before the flag
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
