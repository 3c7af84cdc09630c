// Readings at the sensors over time, from lines time_s,current_a,voltage_v[,temperature_c].
#ifndef BOARD_SIM_READINGS_H
#define BOARD_SIM_READINGS_H

#include <stdbool.h>

typedef struct {
    double time_s;
    double current_a;      // positive on discharge
    double voltage_v;
    double temperature_c;  // NaN: no NTC
} reading;

// Opens a file, or stdin for "-", and skips a heading. If it cannot be read, prints the reason and returns false.
bool readings_open(const char *path, bool loop);

// Returns the last line that is not later than time_s, the time since the first line. time_s must never decrease.
const reading *readings_at(double time_s);

// Returns true if the time of the last line is reached.
bool readings_ended(void);

#endif
