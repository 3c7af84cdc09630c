// Headers of the firmware on the host. The program answers each input line with one output line:
//   sample|hello|ack NUMBER...   packet and frame of the message in hexadecimal
//   unframe HEX                  packet without CRC of a frame without delimiter; "bad" for an invalid frame
//   timing RATE                  pairs of conversions in a window, length of the window in ns, auxiliary readings in it
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "protocol.h"
#include "timing.h"

static uint32_t number(void) { return (uint32_t)strtoul(strtok(NULL, " \n"), NULL, 10); }

static void print_hex(const uint8_t *bytes, uint8_t length) {
    for (uint8_t i = 0; i < length; i++) printf("%02x", bytes[i]);
}

static void print_packet_and_frame(const uint8_t *packet, uint8_t length) {
    uint8_t frame[FRAME_MAX_BYTES];
    print_hex(packet, length);
    putchar(' ');
    print_hex(frame, cobs_encode(frame, packet, length));
    putchar('\n');
}

static void sample(void) {
    uint8_t packet[PACKET_MAX_BYTES];
    sample_message m;
    m.sequence = number();
    m.board_us = number();
    m.voltage_sum = number();
    m.current_sum = number();
    m.count = (uint16_t)number();
    m.aux_sum = (uint16_t)number();
    m.aux_count = (uint8_t)number();
    m.status = (uint8_t)number();
    print_packet_and_frame(packet, encode_sample(packet, &m));
}

static void hello(void) {
    uint8_t packet[PACKET_MAX_BYTES];
    hello_message m;
    m.firmware_major = (uint8_t)number();
    m.firmware_minor = (uint8_t)number();
    m.firmware_patch = (uint8_t)number();
    m.reset_cause = (uint8_t)number();
    m.boot_id = (uint16_t)number();
    m.serial = number();
    m.sequence = number();
    m.board_us = number();
    m.rate_hz = (uint16_t)number();
    m.period_ns = number();
    m.adc_bits = (uint8_t)number();
    m.channels = (uint8_t)number();
    m.divider_ppm = number();
    m.current_uv_per_a = number();
    m.current_zero_ppm = number();
    m.bandgap_uv = number();
    m.bandgap_sum = number();
    m.bandgap_count = (uint16_t)number();
    m.ntc_series_ohm = number();
    m.ntc_r25_ohm = number();
    m.ntc_beta_k = (uint16_t)number();
    print_packet_and_frame(packet, encode_hello(packet, &m));
}

static void ack(void) {
    uint8_t packet[PACKET_MAX_BYTES];
    ack_message m;
    m.command = (uint8_t)number();
    m.result = (uint8_t)number();
    m.value = number();
    print_packet_and_frame(packet, encode_ack(packet, &m));
}

static void unframe(void) {
    uint8_t buffer[FRAME_MAX_BYTES], length = 0;
    const char *hex = strtok(NULL, " \n");
    unsigned byte;
    for (; hex && sscanf(hex, "%2x", &byte) == 1; hex += 2) {
        if (length == sizeof buffer) {
            puts("bad");
            return;
        }
        buffer[length++] = (uint8_t)byte;
    }
    const uint8_t packet = cobs_decode(buffer, length);
    if (crc_matches(buffer, packet))
        print_hex(buffer, packet - CRC_BYTES);
    else
        printf("bad");
    putchar('\n');
}

static void timing(void) {
    const window_timing t = timing_of((uint16_t)number());
    printf("%u %u %u\n", t.slots / 2u, period_ns(&t), t.aux_readings);
}

int main(void) {
    char line[512];
    while (fgets(line, sizeof line, stdin)) {
        const char *word = strtok(line, " \n");
        if (strcmp(word, "sample") == 0) sample();
        if (strcmp(word, "hello") == 0) hello();
        if (strcmp(word, "ack") == 0) ack();
        if (strcmp(word, "unframe") == 0) unframe();
        if (strcmp(word, "timing") == 0) timing();
    }
}
