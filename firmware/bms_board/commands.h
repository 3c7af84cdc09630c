// Commands of the host, and the board's responses.
#ifndef BMS_BOARD_COMMANDS_H
#define BMS_BOARD_COMMANDS_H

#include "sampling.h"

// Queues the first hello.
void commands_start(const boot_readings &boot);

// Handles received commands. A response waits until the line has room, and the later commands wait, too.
void commands_poll();

// Handles a sample before it is sent. The hello reports its sequence and time, and a measurement of the zero sums it.
void commands_see(const sample_message &sample);

#endif
