// The converter. Timer 1 triggers it, its interrupt sums the conversions of a window, and each window is one sample.
#ifndef BMS_BOARD_SAMPLING_H
#define BMS_BOARD_SAMPLING_H

#include "protocol.h"
#include "timing.h"

// Readings of the converter before the first sample.
typedef struct {
    uint32_t bandgap_sum;
    uint16_t bandgap_count;
    bool ntc_fitted;
} boot_readings;

boot_readings sampling_measure_at_boot();
void sampling_start(bool ntc_fitted);

// Sets the timing of the next window and all later ones.
void sampling_set_timing(const window_timing &timing);
const window_timing &sampling_timing();

// Returns the window that has ended, or null. It does not change until it is released, while the next one is summed.
sample_message *sampling_window();
void sampling_release();

// Sleeps until the next interrupt while a conversion runs, because a halted CPU makes less noise. Between two
// conversions, halting the CPU would start one.
void sampling_sleep();

#endif
