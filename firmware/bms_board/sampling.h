// The converter: triggered by timer 1, summed up by its interrupt, handed over window by window.
#ifndef BMS_BOARD_SAMPLING_H
#define BMS_BOARD_SAMPLING_H

#include "protocol.h"
#include "timing.h"

// What the converter found before the first sample.
typedef struct {
    uint32_t bandgap_sum;
    uint16_t bandgap_count;
    bool ntc_fitted;
} boot_readings;

boot_readings sampling_measure_at_boot();
void sampling_start(bool ntc_fitted);

// From the next window on.
void sampling_set_timing(const window_timing &timing);
const window_timing &sampling_timing();

// The window that has ended, or null. It stays as it is until released; meanwhile the next one is summed up.
sample_message *sampling_window();
void sampling_release();

// Sleeps until the next interrupt while a conversion runs: a halted CPU is quiet, and a conversion must be running
// since halting the CPU between two would start one.
void sampling_sleep();

#endif
