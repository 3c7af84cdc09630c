// The board's UART as a pseudo-terminal.
#ifndef BOARD_SIM_LINE_H
#define BOARD_SIM_LINE_H

#include <signal.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Returns the path for the host, NULL and has said why when there is no pseudo-terminal.
const char *line_open(void);

// Whether a host has it open.
bool line_has_host(void);

void line_put(uint8_t byte);

// Writes what was put. Waits while the host does not read, for a simulation has time; what nobody hears is lost.
void line_flush(const volatile sig_atomic_t *stop);

// What the host has sent; returns the number of bytes, 0 when there are none.
size_t line_read(uint8_t *to, size_t room);

#endif
