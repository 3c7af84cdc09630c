#include "reset.h"

#include <avr/interrupt.h>
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
// Optiboot clears MCUSR and hands it on in r2, as the restart below does; old ones clear it without handing it on.
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

// In interrupt and system reset mode the first time-out calls the interrupt below, and only where interrupts have been
// locked until the second does the watchdog reset the chip.
void reset_start_watchdog() {
    wdt_enable(WDTO_250MS);
    WDTCSR |= _BV(WDIE);
}

// Starts the sketch anew without a reset of the chip: after that the watchdog would go on with 16 ms, in which the boot
// loader of Nanos of before 2018 never gets as far as the sketch. save_cause turns the watchdog off, long before its next
// time-out. As at a reset interrupts are off now; the core turns them on before the sketch has set up its rings and
// windows, so their sources are put back, and the pull-up of the NTC's pin. All other registers are written whole when
// they are used. The stack may be what went wrong: nothing is pushed. Software can only clear MCUSR, hence r2.
ISR(WDT_vect, ISR_NAKED) {
    asm volatile("clr r1");  // the compiler's zero
    TIMSK0 = TIMSK1 = TIMSK2 = 0;
    ADCSRA = 0;
    UCSR0B = 0;
    PORTC = 0;
    asm volatile(
        "mov r2, %0\n\t"
        "jmp 0" ::"r"((uint8_t)_BV(WDRF)));
}

void reset_feed_watchdog() {
    if (!restarting) wdt_reset();
}

void reset_restart() { restarting = true; }
