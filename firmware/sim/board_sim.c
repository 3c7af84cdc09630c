// Simulator that runs the firmware's ELF file, with readings at its sensors and a pseudo-terminal as its line.

#include <getopt.h>
#include <math.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_time.h>
#include <sys/prctl.h>
#include <time.h>

#include "line.h"
#include "readings.h"
#include "sensors.h"

#define MCUSR_ADDRESS 0x54
#define WATCHDOG_RESET 0x08
#define TURN_CYCLES 16000    // between two calls of ``turn``: 1 ms
#define BYTE_CYCLES 352      // simavr counts 11 bits a byte instead of 10, and drops faster bytes
#define NEVER UINT64_MAX
#define LATE_S 0.05          // a longer delay is not made up for
#define BOOT_LOADER_S 0.05   // from the opening of the line by the host to the start of the board

static const char usage[] =
    "usage: board_sim ELF --readings FILE|- [--speed X] [--avcc-mv MV] [--noise-lsb LSB] [--seed N]\n"
    "                     [--loop] [--stop-at-end] [--relay]\n"
    "Prints the path of the board's serial line. The board starts when a host opens it, as an Arduino does.\n"
    "  --readings     lines time_s,current_a,voltage_v[,temperature_c], each held until the next; -: stdin\n"
    "  --speed        board seconds per second, default 1; inf: as fast as the host reads\n"
    "  --avcc-mv      supply and reference of the converter, default 5000\n"
    "  --noise-lsb    standard deviation of a conversion, default 0.5\n"
    "  --loop         begin again after the last line; default: hold it\n"
    "  --stop-at-end  exit at the last line\n"
    "  --relay        the relay pin cuts the load while it is high\n";

typedef struct {
    const char *elf, *readings;
    double speed;
    converter parts;
    bool loop, stop_at_end;
} options;

static volatile sig_atomic_t stop;
static avr_irq_t *uart_input;
static uint8_t heard[4096];
static size_t heard_length, heard_used;
static double speed, anchor_s;  // wall time at board time 0

static void on_signal(int number) {
    (void)number;
    stop = 1;
}

static double wall_s(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void pause_s(double seconds) {
    const struct timespec span = {(time_t)seconds, (long)(1e9 * fmod(seconds, 1.0))};
    nanosleep(&span, NULL);
}

static void pace(double board_s) {
    if (isinf(speed)) return;
    const double early_s = anchor_s + board_s / speed - wall_s();
    if (early_s > 0.0)
        pause_s(early_s);
    else if (early_s < -LATE_S)
        anchor_s -= early_s;
}

static void on_transmit(struct avr_irq_t *irq, uint32_t byte, void *param) {
    (void)irq;
    (void)param;
    line_put((uint8_t)byte);
}

static avr_cycle_count_t hear_byte(avr_cycle_count_t now) {
    if (heard_used == heard_length) return NEVER;
    avr_raise_irq(uart_input, heard[heard_used++]);
    return now + BYTE_CYCLES;
}

static void turn(double board_s) {
    line_flush(&stop);
    if (heard_used == heard_length) {
        heard_used = 0;
        heard_length = line_read(heard, sizeof heard);
    }
    pace(board_s);
}

// Runs the board, and counts cycles itself: a reset of the board would clear simavr's timers.
static int run(avr_t *avr, const options *o) {
    avr_cycle_count_t next_turn = 0, next_byte = NEVER;
    while (!stop && !(o->stop_at_end && readings_ended())) {
        const int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed) {
            fprintf(stderr, "the firmware has stopped\n");
            return 1;
        }
        if (avr->data[MCUSR_ADDRESS] & WATCHDOG_RESET) {
            fprintf(stderr, "the watchdog has reset the chip: an old boot loader hangs in that\n");
            return 1;
        }
        if (avr->cycle >= next_byte) next_byte = hear_byte(avr->cycle);
        if (avr->cycle >= next_turn) {
            turn((double)avr->cycle / (double)avr->frequency);
            next_turn = avr->cycle + TURN_CYCLES;
            if (next_byte == NEVER && heard_length > 0) next_byte = avr->cycle + BYTE_CYCLES;
        }
    }
    line_flush(&stop);
    return 0;
}

// Does nothing, where simavr would sleep in real time; ``pace`` sleeps in larger steps.
static void skip_sleep(avr_t *avr, avr_cycle_count_t cycles) {
    (void)avr;
    (void)cycles;
}

// Prints errors to stderr, because only the path is printed to stdout.
static void log_errors(avr_t *avr, const int level, const char *format, va_list arguments) {
    (void)avr;
    if (level == LOG_ERROR) vfprintf(stderr, format, arguments);
}

static avr_t *power_up(const options *o) {
    avr_global_logger_set(log_errors);
    elf_firmware_t firmware = {0};
    if (elf_read_firmware(o->elf, &firmware) != 0) {
        fprintf(stderr, "%s: no firmware can be read from it\n", o->elf);
        return NULL;
    }
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    if (!avr) {
        fprintf(stderr, "this simavr knows no atmega328p\n");
        return NULL;
    }
    avr_init(avr);
    avr->frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    avr->sleep = skip_sleep;
    sensors_attach(avr, &o->parts);

    const uint32_t no_flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), (void *)&no_flags);
    uart_input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_transmit, NULL);
    return avr;
}

static bool parse_options(int argc, char **argv, options *o) {
    enum { READINGS, SPEED, AVCC, NOISE, SEED, LOOP, STOP_AT_END, RELAY, HELP };
    static const struct option known[] = {
        {"readings", required_argument, NULL, READINGS}, {"speed", required_argument, NULL, SPEED},
        {"avcc-mv", required_argument, NULL, AVCC},      {"noise-lsb", required_argument, NULL, NOISE},
        {"seed", required_argument, NULL, SEED},         {"loop", no_argument, NULL, LOOP},
        {"stop-at-end", no_argument, NULL, STOP_AT_END}, {"relay", no_argument, NULL, RELAY}, {"help", no_argument, NULL, HELP},
        {NULL, 0, NULL, 0}};
    int which;
    while ((which = getopt_long(argc, argv, "", known, NULL)) != -1) switch (which) {
            case READINGS: o->readings = optarg; break;
            case SPEED: o->speed = strtod(optarg, NULL); break;
            case AVCC: o->parts.avcc_v = 1e-3 * strtod(optarg, NULL); break;
            case NOISE: o->parts.noise_lsb = strtod(optarg, NULL); break;
            case SEED: o->parts.seed = strtoull(optarg, NULL, 0); break;
            case LOOP: o->loop = true; break;
            case STOP_AT_END: o->stop_at_end = true; break;
            case RELAY: o->parts.relay = true; break;
            default: return false;
        }
    if (optind == argc - 1) o->elf = argv[optind];
    return o->elf && o->readings && o->speed > 0.0 && o->parts.avcc_v > 1.1 && o->parts.noise_lsb >= 0.0 &&
           o->parts.seed != 0;
}

int main(int argc, char **argv) {
    options o = {.speed = 1.0, .parts = {.avcc_v = 5.0, .noise_lsb = 0.5, .seed = 1}};
    if (!parse_options(argc, argv, &o)) {
        fputs(usage, stderr);
        return 2;
    }
    if (!readings_open(o.readings, o.loop)) return 2;
    prctl(PR_SET_PDEATHSIG, SIGTERM);  // the simulator ends with its parent process
    avr_t *avr = power_up(&o);
    const char *path = avr ? line_open() : NULL;
    if (!path) return 2;
    const struct sigaction ending = {.sa_handler = on_signal};  // without SA_RESTART, so that a wait for stdin ends
    sigaction(SIGTERM, &ending, NULL);
    sigaction(SIGINT, &ending, NULL);
    printf("%s\n", path);
    fflush(stdout);

    while (!stop && !line_has_host()) pause_s(0.01);
    pause_s(BOOT_LOADER_S);
    speed = o.speed;
    anchor_s = wall_s();
    return run(avr, &o);
}
