// Settings in EEPROM, each with its own CRC.
#ifndef BMS_BOARD_SETTINGS_H
#define BMS_BOARD_SETTINGS_H

#include <stdint.h>

// Settings in the order of the EEPROM. New ones are appended, so that boards keep their stored values.
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

// Reads all settings. A value that was never set, was only partly written or is out of range becomes the default.
void settings_load();

uint32_t settings_get(setting which);

// Changes a setting at once; settings_write_on stores it later. Returns false if the value is out of range.
bool settings_set(setting which, uint32_t value);

// Writes one byte if the EEPROM is ready for it. It never waits; call it in each loop.
void settings_write_on();

#endif
