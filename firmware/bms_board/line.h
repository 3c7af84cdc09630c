// The serial line. Interrupts send from a ring buffer and receive into another one.
#ifndef BMS_BOARD_LINE_H
#define BMS_BOARD_LINE_H

#include <stdint.h>

void line_start();

// Frames a packet and queues the frame. Returns false and queues nothing if there is no room. It never waits.
bool line_send(const uint8_t *packet, uint8_t length);

// Returns the next packet with a right CRC, or null. The packet is valid until the next call.
const uint8_t *line_receive(uint8_t *length);

#endif
