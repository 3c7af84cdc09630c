#include "reset.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "settings.h"

#define CAUSES 0x0F

// Variables that the start-up code does not initialize. RAM retains them through every reset except power-on.
static uint8_t cause __attribute__((section(".noinit")));
static uint16_t boot_id __attribute__((section(".noinit")));
static uint16_t boot_id_inverted __attribute__((section(".noinit")));

static bool restarting;

// Runs before the other start-up code, because after a watchdog reset the watchdog stays on with its shortest timeout.
// Optiboot clears MCUSR and passes it on in r2, as the restart below does. Older boot loaders clear it only.
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

// The upper byte counts power-ups in EEPROM. The other resets are counted in RAM, which does not wear.
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

// In interrupt and system reset mode, the first timeout calls the interrupt below. The watchdog resets the chip only if
// interrupts are disabled until the second timeout.
void reset_start_watchdog() {
    wdt_enable(WDTO_250MS);
    WDTCSR |= _BV(WDIE);
}

// Restarts the sketch without a reset of the chip. After a reset the watchdog would stay on with 16 ms, in which the boot
// loader of Nanos built before 2018 does not reach the sketch. save_cause turns the watchdog off before its next timeout.
// As at a reset, interrupts are disabled now. The core enables them before the sketch has set up its ring buffers and
// windows. Therefore their sources are reset here, and the pull-up of the NTC's pin. All other registers are written
// completely before they are used. Nothing is pushed, because the stack may be damaged. The cause is passed on in r2,
// because software can only clear MCUSR.
ISR(WDT_vect, ISR_NAKED) {
    asm volatile("clr r1");  // the compiler expects 0 in r1
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
