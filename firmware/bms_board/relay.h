// The relay pin D4, which the host sets to disconnect the load or the charger.
#ifndef BMS_BOARD_RELAY_H
#define BMS_BOARD_RELAY_H

#include <stdint.h>

// Sets the pin low, as after every reset.
void relay_start();

// Applies the value of COMMAND_SET_RELAY. Returns false and changes nothing if the value is not valid.
bool relay_set(uint32_t number);

// Returns the last applied value; 0 after a reset.
uint32_t relay_get();

// Measures the silence of the host by the time of each sample.
void relay_see(uint32_t board_us);

#endif
