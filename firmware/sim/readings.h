// What is at the sensors, by time: lines of time_s,current_a,voltage_v[,temperature_c].
#ifndef BOARD_SIM_READINGS_H
#define BOARD_SIM_READINGS_H

#include <stdbool.h>

typedef struct {
    double time_s;
    double current_a;      // positive on discharge
    double voltage_v;
    double temperature_c;  // NaN: no NTC
} reading;

// From a file or, with "-", from stdin; a heading is passed over. Returns false, and has said why, when it cannot be read.
bool readings_open(const char *path, bool loop);

// What holds at time_s since the first line, which never goes back: the last line not after it.
const reading *readings_at(double time_s);

// Whether the last line's time has come.
bool readings_ended(void);

#endif
