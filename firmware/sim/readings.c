#include "readings.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static FILE *file;
static bool looped;
static double offset_s;  // time offset of the present pass over the file
static reading held, next;
static bool have_next;

static bool parse(const char *line, reading *r) {
    r->temperature_c = NAN;
    return sscanf(line, "%lf,%lf,%lf,%lf", &r->time_s, &r->current_a, &r->voltage_v, &r->temperature_c) >= 3;
}

static bool read_line(reading *r) {
    char line[256];
    while (fgets(line, sizeof line, file))
        if (parse(line, r)) {
            r->time_s += offset_s;
            return true;
        }
    return false;
}

static void fetch(void) {
    have_next = read_line(&next);
    if (have_next || !looped) return;
    rewind(file);
    offset_s = held.time_s;  // the last line of a pass and the first line of the next one have the same time
    have_next = read_line(&next);
}

bool readings_open(const char *path, bool loop) {
    looped = loop;
    file = strcmp(path, "-") == 0 ? stdin : fopen(path, "r");
    if (!file) {
        perror(path);
        return false;
    }
    if (!read_line(&held)) {
        fprintf(stderr, "%s: holds no line time_s,current_a,voltage_v[,temperature_c]\n", path);
        return false;
    }
    offset_s = -held.time_s;
    next = held;
    next.time_s = 0.0;
    held = next;
    fetch();
    return true;
}

const reading *readings_at(double time_s) {
    while (have_next && next.time_s <= time_s) {
        const bool stands_still = looped && next.time_s <= held.time_s && next.time_s == 0.0;
        held = next;
        fetch();
        if (stands_still) break;  // a file of one line would loop forever
    }
    return &held;
}

bool readings_ended(void) { return !have_next; }
