// Protocol between board and host, version 1. PROTOCOL.md beside the folder explains it.
// This header is the only definition in C: the sketch and the tests on the host compile it.
#ifndef BMS_BOARD_PROTOCOL_H
#define BMS_BOARD_PROTOCOL_H

#include <stdint.h>

#define PROTOCOL_VERSION 1
#define PROTOCOL_BAUD 500000UL  // exact at 16 MHz with double speed

enum message_type {
    MESSAGE_SAMPLE = 0x01,
    MESSAGE_HELLO = 0x02,
    MESSAGE_ACK = 0x03,
    COMMAND_HELLO = 0x10,
    COMMAND_SET_RATE = 0x11,
    COMMAND_ZERO_CURRENT = 0x12,
    COMMAND_RESTART = 0x13,
    COMMAND_SET_SERIAL = 0x14,
    COMMAND_SET_BANDGAP = 0x15,
    COMMAND_SET_DIVIDER = 0x16,
    COMMAND_SET_CURRENT_SLOPE = 0x17,
    COMMAND_SET_RATIOMETRIC = 0x18,
    COMMAND_SET_RELAY = 0x19
};

enum ack_result {
    ACK_OK = 0,
    ACK_UNKNOWN_COMMAND = 1,
    ACK_BAD_VALUE = 2,
    ACK_BUSY = 3,
    ACK_OTHER_VERSION = 4
};

enum sample_status {
    STATUS_VOLTAGE_SATURATED = 0x01,
    STATUS_CURRENT_SATURATED = 0x02,
    STATUS_OVERRUN = 0x04,
    STATUS_AUX_IS_NTC = 0x08  // the upper half is MCUSR shifted by four
};

#define CHANNEL_NTC 0x01
#define CHANNEL_CURRENT_RATIOMETRIC 0x02

// The value of COMMAND_SET_RELAY: bit 0 is the level, the second byte the level after a silence of the host, and the
// upper half its duration in seconds.
enum relay_silence { RELAY_KEEP = 0, RELAY_LOW = 1, RELAY_HIGH = 2 };
#define RELAY_SILENT_MAX_S 3600

#define RATE_MIN_HZ 1
#define RATE_MAX_HZ 1000
#define RATE_DEFAULT_HZ 100

#define CRC_BYTES 2
#define SAMPLE_BYTES 24
#define HELLO_BYTES 62
#define ACK_BYTES 10
#define PACKET_MAX_BYTES 64
#define FRAME_MAX_BYTES (PACKET_MAX_BYTES + 2)  // COBS adds one byte to less than 254, and a delimiter follows

typedef struct {
    uint32_t sequence;
    uint32_t board_us;
    uint32_t voltage_sum;  // 24 bits on the line
    uint32_t current_sum;  // 24 bits on the line
    uint16_t count;
    uint16_t aux_sum;
    uint8_t aux_count;
    uint8_t status;
} sample_message;

typedef struct {
    uint8_t firmware_major, firmware_minor, firmware_patch;
    uint8_t reset_cause;
    uint16_t boot_id;
    uint32_t serial;
    uint32_t sequence;
    uint32_t board_us;
    uint16_t rate_hz;
    uint32_t period_ns;
    uint8_t adc_bits;
    uint8_t channels;
    uint32_t divider_ppm;
    uint32_t current_uv_per_a;
    uint32_t current_zero_ppm;
    uint32_t bandgap_uv;
    uint32_t bandgap_sum;
    uint16_t bandgap_count;
    uint32_t ntc_series_ohm;
    uint32_t ntc_r25_ohm;
    uint16_t ntc_beta_k;
} hello_message;

typedef struct {
    uint8_t command;
    uint8_t result;
    uint32_t value;
} ack_message;

// CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, no reflection, no final inversion.
static inline uint16_t crc16(const uint8_t *data, uint8_t length) {
    uint16_t crc = 0xFFFF;
    while (length--) {  // a byte at a time without a table, as avr-libc's _crc_xmodem_update
        uint8_t x = (uint8_t)(crc >> 8) ^ *data++;
        x ^= x >> 4;
        crc = (uint16_t)((crc << 8) ^ ((uint16_t)x << 12) ^ ((uint16_t)x << 5) ^ x);
    }
    return crc;
}

// Writes a little-endian number, whatever the byte order of the CPU.
static inline uint8_t *put(uint8_t *to, uint32_t value, uint8_t bytes) {
    while (bytes--) {
        *to++ = (uint8_t)value;
        value >>= 8;
    }
    return to;
}

static inline uint32_t take(const uint8_t *from, uint8_t bytes) {
    uint32_t value = 0;
    while (bytes--) value = (value << 8) | from[bytes];
    return value;
}

static inline uint8_t *put_header(uint8_t *to, uint8_t type) {
    *to++ = PROTOCOL_VERSION;
    *to++ = type;
    return to;
}

// Appends the CRC. Returns the length of the packet.
static inline uint8_t seal(uint8_t *packet, const uint8_t *end) {
    uint8_t length = (uint8_t)(end - packet);
    put(packet + length, crc16(packet, length), CRC_BYTES);
    return length + CRC_BYTES;
}

static inline uint8_t encode_sample(uint8_t *packet, const sample_message *m) {
    uint8_t *to = put_header(packet, MESSAGE_SAMPLE);
    to = put(to, m->sequence, 4);
    to = put(to, m->board_us, 4);
    to = put(to, m->voltage_sum, 3);
    to = put(to, m->current_sum, 3);
    to = put(to, m->count, 2);
    to = put(to, m->aux_sum, 2);
    to = put(to, m->aux_count, 1);
    to = put(to, m->status, 1);
    return seal(packet, to);
}

static inline uint8_t encode_hello(uint8_t *packet, const hello_message *m) {
    uint8_t *to = put_header(packet, MESSAGE_HELLO);
    to = put(to, m->firmware_major, 1);
    to = put(to, m->firmware_minor, 1);
    to = put(to, m->firmware_patch, 1);
    to = put(to, m->reset_cause, 1);
    to = put(to, m->boot_id, 2);
    to = put(to, m->serial, 4);
    to = put(to, m->sequence, 4);
    to = put(to, m->board_us, 4);
    to = put(to, m->rate_hz, 2);
    to = put(to, m->period_ns, 4);
    to = put(to, m->adc_bits, 1);
    to = put(to, m->channels, 1);
    to = put(to, m->divider_ppm, 4);
    to = put(to, m->current_uv_per_a, 4);
    to = put(to, m->current_zero_ppm, 4);
    to = put(to, m->bandgap_uv, 4);
    to = put(to, m->bandgap_sum, 4);
    to = put(to, m->bandgap_count, 2);
    to = put(to, m->ntc_series_ohm, 4);
    to = put(to, m->ntc_r25_ohm, 4);
    to = put(to, m->ntc_beta_k, 2);
    return seal(packet, to);
}

static inline uint8_t encode_ack(uint8_t *packet, const ack_message *m) {
    uint8_t *to = put_header(packet, MESSAGE_ACK);
    to = put(to, m->command, 1);
    to = put(to, m->result, 1);
    to = put(to, m->value, 4);
    return seal(packet, to);
}

// Encodes by COBS and appends the delimiter. Returns the length of the frame: length + 2 for packets below 254 bytes.
static inline uint8_t cobs_encode(uint8_t *frame, const uint8_t *packet, uint8_t length) {
    uint8_t *code = frame, *to = frame + 1;
    *code = 1;
    while (length--) {
        if (*packet) {
            *to++ = *packet;
            (*code)++;
        } else {
            code = to++;
            *code = 1;
        }
        packet++;
    }
    *to++ = 0;
    return (uint8_t)(to - frame);
}

// Decodes COBS in place, without the delimiter. Returns the length of the packet; 0 if it is not COBS.
static inline uint8_t cobs_decode(uint8_t *buffer, uint8_t length) {
    uint8_t from = 0, to = 0;
    while (from < length) {
        uint8_t code = buffer[from++];
        if (code == 0 || code - 1 > length - from) return 0;
        while (--code) {
            if (buffer[from] == 0) return 0;
            buffer[to++] = buffer[from++];
        }
        if (from < length) buffer[to++] = 0;
    }
    return to;
}

static inline uint8_t crc_matches(const uint8_t *packet, uint8_t length) {
    return length >= 2 + CRC_BYTES && crc16(packet, length - CRC_BYTES) == take(packet + length - CRC_BYTES, CRC_BYTES);
}

#endif
