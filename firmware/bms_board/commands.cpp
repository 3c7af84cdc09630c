#include "commands.h"

#include "line.h"
#include "relay.h"
#include "reset.h"
#include "settings.h"

#define FIRMWARE_MAJOR 0
#define FIRMWARE_MINOR 2
#define FIRMWARE_PATCH 0

#define ADC_BITS 10
#define NTC_SERIES_OHM 10000UL
#define NTC_R25_OHM 10000UL
#define NTC_BETA_K 3950

#define ZERO_US 1000000UL

static boot_readings boot;
static uint16_t boot_id;

static uint32_t next_sequence, last_us;  // sequence of the next sample, and time of the last one

static bool hello_wanted;
static uint8_t ack[ACK_BYTES];
static uint8_t ack_length;  // 0: no acknowledgment waits

static struct {
    bool measuring, begun, measured;
    uint32_t begin_us, sum, count;
} zero;

static void answer_ack(uint8_t command, uint8_t result, uint32_t value) {
    const ack_message message = {command, result, value};
    ack_length = encode_ack(ack, &message);
}

// Builds the hello only when the line has room: its sequence must not be older than that of a sample sent meanwhile.
static bool send_hello() {
    hello_message hello = {};
    hello.firmware_major = FIRMWARE_MAJOR;
    hello.firmware_minor = FIRMWARE_MINOR;
    hello.firmware_patch = FIRMWARE_PATCH;
    hello.reset_cause = reset_cause();
    hello.boot_id = boot_id;
    hello.serial = settings_get(SETTING_SERIAL);
    hello.sequence = next_sequence;
    hello.board_us = last_us;
    hello.rate_hz = sampling_timing().rate_hz;
    hello.period_ns = period_ns(&sampling_timing());
    hello.adc_bits = ADC_BITS;
    hello.channels = (boot.ntc_fitted ? CHANNEL_NTC : 0) |
                     (settings_get(SETTING_CURRENT_RATIOMETRIC) ? CHANNEL_CURRENT_RATIOMETRIC : 0);
    hello.divider_ppm = settings_get(SETTING_DIVIDER_PPM);
    hello.current_uv_per_a = settings_get(SETTING_CURRENT_UV_PER_A);
    hello.current_zero_ppm = settings_get(SETTING_CURRENT_ZERO_PPM);
    hello.bandgap_uv = settings_get(SETTING_BANDGAP_UV);
    hello.bandgap_sum = boot.bandgap_sum;
    hello.bandgap_count = boot.bandgap_count;
    hello.ntc_series_ohm = NTC_SERIES_OHM;
    hello.ntc_r25_ohm = NTC_R25_OHM;
    hello.ntc_beta_k = NTC_BETA_K;
    uint8_t packet[HELLO_BYTES];
    return line_send(packet, encode_hello(packet, &hello));
}

static void answer_setting(uint8_t command, setting which, uint32_t value) {
    const bool set = settings_set(which, value);
    answer_ack(command, set ? ACK_OK : ACK_BAD_VALUE, settings_get(which));
}

static void set_rate(uint32_t rate_hz) {
    const bool good = rate_hz >= RATE_MIN_HZ && rate_hz <= RATE_MAX_HZ;
    if (good) sampling_set_timing(timing_of((uint16_t)rate_hz));
    answer_ack(COMMAND_SET_RATE, good ? ACK_OK : ACK_BAD_VALUE, period_ns(&sampling_timing()));
}

static void set_relay(uint32_t number) {
    const bool good = relay_set(number);
    answer_ack(COMMAND_SET_RELAY, good ? ACK_OK : ACK_BAD_VALUE, relay_get());
}

static void zero_current() {
    if (zero.measuring) {
        answer_ack(COMMAND_ZERO_CURRENT, ACK_BUSY, settings_get(SETTING_CURRENT_ZERO_PPM));
        return;
    }
    zero.measuring = true;
    zero.begun = zero.measured = false;
    zero.sum = zero.count = 0;
}

static void add_to_zero(const sample_message &sample) {
    if (!zero.begun) {  // this window may have begun before the command
        zero.begun = true;
        zero.begin_us = sample.board_us;
        return;
    }
    zero.sum += sample.current_sum;
    zero.count += sample.count;
    zero.measured = sample.board_us - zero.begin_us >= ZERO_US;
}

void commands_see(const sample_message &sample) {
    next_sequence = sample.sequence + 1;
    last_us = sample.board_us;
    relay_see(sample.board_us);
    if (zero.measuring && !zero.measured) add_to_zero(sample);
}

static void end_zero() {
    zero.measuring = false;
    // sum / count / 1024 in ppm; 64 bits, because the sum of a second times a million needs 42
    const uint64_t scaled = (uint64_t)zero.sum * 1000000UL / zero.count;
    answer_setting(COMMAND_ZERO_CURRENT, SETTING_CURRENT_ZERO_PPM, (uint32_t)((scaled + (1 << 9)) >> ADC_BITS));
}

// Returns the setting that a command with one number changes; SETTINGS if it changes none.
static setting setting_of(uint8_t command) {
    switch (command) {
        case COMMAND_SET_SERIAL: return SETTING_SERIAL;
        case COMMAND_SET_BANDGAP: return SETTING_BANDGAP_UV;
        case COMMAND_SET_DIVIDER: return SETTING_DIVIDER_PPM;
        case COMMAND_SET_CURRENT_SLOPE: return SETTING_CURRENT_UV_PER_A;
        case COMMAND_SET_RATIOMETRIC: return SETTING_CURRENT_RATIOMETRIC;
        default: return SETTINGS;
    }
}

static void obey(const uint8_t *packet, uint8_t length) {
    const uint8_t command = packet[1], *body = packet + 2, bytes = length - 2;
    if (packet[0] != PROTOCOL_VERSION)
        answer_ack(command, ACK_OTHER_VERSION, PROTOCOL_VERSION);
    else if (command == COMMAND_HELLO)
        hello_wanted = true;
    else if (command == COMMAND_SET_RATE && bytes == 2)
        set_rate(take(body, 2));
    else if (command == COMMAND_ZERO_CURRENT)
        zero_current();
    else if (command == COMMAND_SET_RELAY && bytes == 4)
        set_relay(take(body, 4));
    else if (setting_of(command) != SETTINGS && bytes == 4)
        answer_setting(command, setting_of(command), take(body, 4));
    else if (command == COMMAND_RESTART) {
        answer_ack(command, ACK_OK, 0);
        reset_restart();
    } else
        answer_ack(command, ACK_UNKNOWN_COMMAND, 0);
}

void commands_start(const boot_readings &readings) {
    boot = readings;
    boot_id = reset_count_boot();
    hello_wanted = true;
    commands_poll();
}

void commands_poll() {
    if (hello_wanted && !send_hello()) return;
    hello_wanted = false;
    if (ack_length && !line_send(ack, ack_length)) return;
    ack_length = 0;
    if (zero.measuring && zero.measured) {
        end_zero();
        return;
    }
    uint8_t length;
    const uint8_t *packet = line_receive(&length);
    if (packet) obey(packet, length);
}
