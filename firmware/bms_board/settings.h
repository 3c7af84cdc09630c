// What the board keeps in EEPROM, each value with a check of its own.
#ifndef BMS_BOARD_SETTINGS_H
#define BMS_BOARD_SETTINGS_H

#include <stdint.h>

// In this order in the EEPROM: new ones go to the end, so that boards keep what they have.
enum setting : uint8_t {
    SETTING_SERIAL,
    SETTING_BANDGAP_UV,
    SETTING_CURRENT_ZERO_PPM,
    SETTING_POWER_UPS,
    SETTING_DIVIDER_PPM,
    SETTING_CURRENT_UV_PER_A,
    SETTING_CURRENT_RATIOMETRIC,
    SETTINGS
};

#define BANDGAP_MIN_UV 1000000UL
#define BANDGAP_MAX_UV 1200000UL
#define CURRENT_ZERO_MIN_PPM 400000UL
#define CURRENT_ZERO_MAX_PPM 600000UL
#define DIVIDER_MIN_PPM 1000000UL
#define DIVIDER_MAX_PPM 100000000UL
#define CURRENT_MIN_UV_PER_A 1000UL
#define CURRENT_MAX_UV_PER_A 2000000UL

// Reads all; a value that was never set, was half written or is out of its range is the default.
void settings_load();

uint32_t settings_get(setting which);

// Returns false when the value is out of its range. What holds changes at once, the EEPROM follows.
bool settings_set(setting which, uint32_t value);

// Writes one byte if the EEPROM is ready for it: call it often, it never waits.
void settings_write_on();

#endif
