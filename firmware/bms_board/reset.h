// Why the board was reset, how often, and how it resets itself.
#ifndef BMS_BOARD_RESET_H
#define BMS_BOARD_RESET_H

#include <stdint.h>

// MCUSR after the last reset; 0 where a boot loader has cleared it and does not tell.
uint8_t reset_cause();

// Another number after each reset.
uint16_t reset_count_boot();

void reset_start_watchdog();

// To be called in each loop; in vain once a restart was asked for.
void reset_feed_watchdog();

void reset_restart();

#endif
