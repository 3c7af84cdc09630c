// The board's UART as a pseudo-terminal.
#ifndef BOARD_SIM_LINE_H
#define BOARD_SIM_LINE_H

#include <signal.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Returns the path for the host. Without a pseudo-terminal it prints the reason and returns NULL.
const char *line_open(void);

// Returns true if a host has opened the line.
bool line_has_host(void);

void line_put(uint8_t byte);

// Writes the bytes of line_put. Waits while the host does not read, because simulated time can wait. Without a host the
// bytes are lost.
void line_flush(const volatile sig_atomic_t *stop);

// Reads the bytes that the host has sent. Returns their number, which may be 0.
size_t line_read(uint8_t *to, size_t room);

#endif
