#include "reset.h"

#include <avr/io.h>
#include <avr/wdt.h>

#include "settings.h"

#define CAUSES 0x0F

// Not touched by the start-up code: the RAM keeps them through every reset but a power-on.
static uint8_t cause __attribute__((section(".noinit")));
static uint16_t boot_id __attribute__((section(".noinit")));
static uint16_t boot_id_inverted __attribute__((section(".noinit")));

static bool restarting;

// Before anything else: after a watchdog reset the watchdog goes on with its shortest time.
// Optiboot clears MCUSR and hands it on in r2, old ones without handing it on.
extern "C" void save_cause() __attribute__((naked, used, section(".init3")));
void save_cause() {
    uint8_t by_loader;
    asm volatile("mov %0, r2" : "=r"(by_loader));
    cause = MCUSR;
    if (cause == 0 && by_loader <= CAUSES) cause = by_loader;
    MCUSR = 0;
    wdt_disable();
}

uint8_t reset_cause() { return cause & CAUSES; }

// Power-ups are counted in EEPROM, in the upper byte; other resets go on counting in RAM, which does not wear.
uint16_t reset_count_boot() {
    if (boot_id_inverted == (uint16_t)~boot_id) {
        boot_id++;
    } else {
        const uint32_t power_ups = settings_get(SETTING_POWER_UPS) + 1;
        settings_set(SETTING_POWER_UPS, power_ups);
        boot_id = (uint16_t)(power_ups << 8);
    }
    boot_id_inverted = ~boot_id;
    return boot_id;
}

void reset_start_watchdog() { wdt_enable(WDTO_250MS); }

void reset_feed_watchdog() {
    if (!restarting) wdt_reset();
}

void reset_restart() { restarting = true; }
