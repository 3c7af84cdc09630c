#include "settings.h"

#include <avr/eeprom.h>

#include "protocol.h"

#define VALUE_BYTES 4
#define RECORD_BYTES (VALUE_BYTES + CRC_BYTES)

struct allowed {
    uint32_t least, most, otherwise;
};

static const allowed ranges[SETTINGS] = {
    {0, 0xFFFFFFFF, 0},
    {BANDGAP_MIN_UV, BANDGAP_MAX_UV, 1100000},
    {CURRENT_ZERO_MIN_PPM, CURRENT_ZERO_MAX_PPM, 500000},
    {0, 0xFFFFFFFF, 0},
    {DIVIDER_MIN_PPM, DIVIDER_MAX_PPM, 6100000},           // 51 kohm over 10 kohm, docs/pack/board.md
    {CURRENT_MIN_UV_PER_A, CURRENT_MAX_UV_PER_A, 100000},  // ACS724LLCTR-20AB
    {0, 1, 1},                                             // it is proportional to its supply
};

static uint8_t records[SETTINGS][RECORD_BYTES];
static uint8_t unwritten = sizeof records;  // index of the next byte to write; the size: all are written

// Returns the CRC of a setting's index and value.
static uint16_t check_of(uint8_t which) {
    uint8_t checked[1 + VALUE_BYTES] = {which};
    for (uint8_t i = 0; i < VALUE_BYTES; i++) checked[1 + i] = records[which][i];
    return crc16(checked, sizeof checked);
}

static void store(uint8_t which, uint32_t value) {
    put(records[which], value, VALUE_BYTES);
    put(records[which] + VALUE_BYTES, check_of(which), CRC_BYTES);
}

static bool within(uint8_t which, uint32_t value) {
    return value >= ranges[which].least && value <= ranges[which].most;
}

void settings_load() {
    eeprom_read_block(records, nullptr, sizeof records);
    for (uint8_t which = 0; which < SETTINGS; which++) {
        const bool whole = take(records[which] + VALUE_BYTES, CRC_BYTES) == check_of(which);
        if (!whole || !within(which, take(records[which], VALUE_BYTES))) store(which, ranges[which].otherwise);
    }
}

uint32_t settings_get(setting which) { return take(records[which], VALUE_BYTES); }

bool settings_set(setting which, uint32_t value) {
    if (!within(which, value)) return false;
    store(which, value);
    unwritten = 0;
    return true;
}

void settings_write_on() {
    const uint8_t *bytes = &records[0][0];
    if (unwritten == sizeof records || !eeprom_is_ready()) return;
    eeprom_update_byte((uint8_t *)(uintptr_t)unwritten, bytes[unwritten]);
    unwritten++;
}
