// What the host asks for.
#ifndef BMS_BOARD_COMMANDS_H
#define BMS_BOARD_COMMANDS_H

#include "sampling.h"

// Queues the first hello.
void commands_start(const boot_readings &boot);

// Takes and answers what has come. An answer waits until the line has room, and so do the commands behind it.
void commands_poll();

// Every sample passes here before it is sent: the hello tells where it stands, a measurement of the zero adds it up.
void commands_see(const sample_message &sample);

#endif
