// A pin that the host sets, to cut the load or the charger: D4, high or low.
#ifndef BMS_BOARD_RELAY_H
#define BMS_BOARD_RELAY_H

#include <stdint.h>

// Low, as after every reset.
void relay_start();

// Takes the number of the command. Returns false, and changes nothing, when it is none.
bool relay_set(uint32_t number);

// The number that holds; 0 after a reset.
uint32_t relay_get();

// Every sample's time passes here: it tells for how long the host has been silent.
void relay_see(uint32_t board_us);

#endif
