// Divider, current sensor, NTC and the analog side of the converter.
#ifndef BOARD_SIM_SENSORS_H
#define BOARD_SIM_SENSORS_H

#include <simavr/sim_avr.h>
#include <stdbool.h>
#include <stdint.h>

typedef struct {
    double avcc_v;
    double noise_lsb;  // standard deviation of a conversion
    uint64_t seed;
    bool relay;  // the board's pin D4 cuts the load while it is high
} converter;

// Makes timer 1 trigger the converter, and supplies each conversion with the readings of its time.
void sensors_attach(avr_t *avr, const converter *c);

#endif
