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

// Lets timer 1 trigger the converter and feeds each conversion with what the readings say at its moment.
void sensors_attach(avr_t *avr, const converter *c);

#endif
