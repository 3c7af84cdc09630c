// The serial line: rings at both ends that are emptied and filled by interrupts.
#ifndef BMS_BOARD_LINE_H
#define BMS_BOARD_LINE_H

#include <stdint.h>

void line_start();

// Frames a packet and queues it whole. Returns false, and queues nothing, when there is no room: it never waits.
bool line_send(const uint8_t *packet, uint8_t length);

// The next packet with a right CRC, or null. It stays until the next call.
const uint8_t *line_receive(uint8_t *length);

#endif
