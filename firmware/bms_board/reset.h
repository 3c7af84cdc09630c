// Cause and count of resets, the watchdog, and the restart of the board.
#ifndef BMS_BOARD_RESET_H
#define BMS_BOARD_RESET_H

#include <stdint.h>

// Returns MCUSR after the last reset; 0 if a boot loader has cleared it without passing it on.
uint8_t reset_cause();

// Returns the boot id, which differs after each reset.
uint16_t reset_count_boot();

void reset_start_watchdog();

// Restarts the watchdog timer; call it in each loop. It does nothing after reset_restart.
void reset_feed_watchdog();

void reset_restart();

#endif
