#include "line.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <stdio.h>
#include <termios.h>
#include <unistd.h>

#define LOOK_MS 50  // interval at which a wait checks if it must stop

static int master = -1;
static char name[128];
static uint8_t waiting[1 << 16];
static size_t filled;

const char *line_open(void) {
    struct termios raw;
    int slave;
    cfmakeraw(&raw);
    raw.c_cflag = CS8 | CREAD | CLOCAL;
    if (openpty(&master, &slave, name, &raw, NULL) != 0) {
        perror("openpty");
        return NULL;
    }
    close(slave);  // the master then detects hosts; the settings remain
    fcntl(master, F_SETFL, O_NONBLOCK);
    return name;
}

bool line_has_host(void) {
    struct pollfd look = {.fd = master, .events = 0};
    return poll(&look, 1, 0) >= 0 && !(look.revents & POLLHUP);
}

void line_put(uint8_t byte) {
    if (filled < sizeof waiting) waiting[filled++] = byte;
}

void line_flush(const volatile sig_atomic_t *stop) {
    size_t done = 0;
    while (done < filled && line_has_host() && !*stop) {
        const ssize_t written = write(master, waiting + done, filled - done);
        if (written > 0) {
            done += (size_t)written;
        } else {
            struct pollfd room = {.fd = master, .events = POLLOUT};
            poll(&room, 1, LOOK_MS);
        }
    }
    filled = 0;
}

size_t line_read(uint8_t *to, size_t room) {
    const ssize_t got = read(master, to, room);
    return got > 0 ? (size_t)got : 0;
}
