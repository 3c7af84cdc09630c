#include "line.h"

#include <avr/interrupt.h>
#include <avr/io.h>

#include "protocol.h"

#define TRANSMIT_ROOM 255  // 8-bit indices wrap at the ring's size
#define RECEIVE_ROOM 255

static volatile uint8_t transmit_ring[256], receive_ring[256];
static volatile uint8_t transmit_head, transmit_tail, receive_head, receive_tail;

void line_start() {
    UCSR0A = _BV(U2X0);
    UBRR0 = F_CPU / 8 / PROTOCOL_BAUD - 1;
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    UDR0 = 0;  // ends a frame that a reset has cut off, which would make the hello invalid
}

ISR(USART_UDRE_vect) {
    const uint8_t tail = transmit_tail;
    UDR0 = transmit_ring[tail];
    transmit_tail = tail + 1;
    if ((uint8_t)(tail + 1) == transmit_head) UCSR0B &= ~_BV(UDRIE0);
}

ISR(USART_RX_vect) {
    const uint8_t byte = UDR0, head = receive_head;
    if ((uint8_t)(head - receive_tail) == RECEIVE_ROOM) return;  // its frame becomes invalid, and the host retries
    receive_ring[head] = byte;
    receive_head = head + 1;
}

bool line_send(const uint8_t *packet, uint8_t length) {
    uint8_t frame[FRAME_MAX_BYTES];
    const uint8_t bytes = cobs_encode(frame, packet, length);
    uint8_t head = transmit_head;
    if ((uint8_t)(TRANSMIT_ROOM - (uint8_t)(head - transmit_tail)) < bytes) return false;
    for (uint8_t i = 0; i < bytes; i++) transmit_ring[head++] = frame[i];
    transmit_head = head;
    UCSR0B |= _BV(UDRIE0);
    return true;
}

const uint8_t *line_receive(uint8_t *length) {
    static uint8_t buffer[FRAME_MAX_BYTES];
    static uint8_t filled;
    static bool overlong;
    while (receive_tail != receive_head) {
        const uint8_t byte = receive_ring[receive_tail];
        receive_tail = receive_tail + 1;
        if (byte != 0) {
            if (filled < sizeof buffer)
                buffer[filled++] = byte;
            else
                overlong = true;
            continue;
        }
        const uint8_t packet = overlong ? 0 : cobs_decode(buffer, filled);
        filled = 0;
        overlong = false;
        if (crc_matches(buffer, packet)) {
            *length = packet - CRC_BYTES;
            return buffer;
        }
    }
    return nullptr;
}
