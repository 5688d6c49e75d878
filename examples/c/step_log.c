/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Step a design over a log, and print the estimates, which equal Python's to the bit.
 *
 *     cc -std=c99 -O3 -ffp-contract=off -fno-math-errno -I "$CORE" examples/c/step_log.c \
 *       $(find "$CORE" -name '*.c' ! -name module.c) -lm -o step_log
 *     ./step_log my_arm.tsobs log.csv > estimates.csv
 *
 * CORE is tsobs_ros/core, and `tsobs export-c my_arm.design.yaml --output my_arm.tsobs` writes the
 * design. The log has a line of names, then one line per sample: time (above 0) [s], outputs [rad]
 * and torques [N m]. An entry that is no number is missing. This file is both C and C++.
 */
#include "tsobs.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void quit(const char *where, const char *why)
{
    fprintf(stderr, "%s: %s\n", where, why);
    exit(1);
}

static void *allocate(size_t bytes)
{
    void *memory = malloc(bytes);
    if (memory == NULL) {
        quit("memory", "none left");
    }
    return memory;
}

/* Return the content of a file, and write its length. */
static void *read_file(const char *name, size_t *bytes)
{
    FILE *file = fopen(name, "rb");
    long size = -1;
    void *content;
    /* A folder can be opened, but not read. */
    if (file != NULL && getc(file) != EOF && fseek(file, 0, SEEK_END) == 0) {
        size = ftell(file);
    }
    if (file == NULL || size < 0) {
        quit(name, "cannot be read, or is empty");
    }
    rewind(file);
    content = allocate((size_t)size + 1);
    *bytes = fread(content, 1, (size_t)size, file);
    fclose(file);
    return content;
}

/* Read numbers between commas; an entry that is no number becomes NaN. */
static void read_numbers(const char *line, double *numbers, int64_t count)
{
    int64_t i;
    for (i = 0; i < count; i++) {
        char *end;
        numbers[i] = strtod(line, &end);
        if (end == line) {
            numbers[i] = (double)NAN;
        }
        for (line = end; *line != ',' && *line != '\0'; line++) {
        }
        line += *line == ',';
    }
}

/* Print the names of an estimate's numbers, from the list of its fields. */
static void print_names(const estimator_sizes *s)
{
    const layout_field fields[] = {ESTIMATE_FIELDS(LAYOUT_ROW, s)};
    size_t i;
    printf("time");
    for (i = 0; i < sizeof fields / sizeof fields[0]; i++) {
        long j;
        for (j = 0; j < fields[i].rows; j++) {
            printf(",%s_%ld", fields[i].name, j + 1);
        }
    }
    printf("\n");
}

int main(int count, char **arguments)
{
    static char line[4096];
    size_t bytes, i;
    exported design;
    tracker joint;
    if (count != 3) {
        quit(arguments[0], "expected an exported design and a log");
    }

    /* All memory is allocated before the first step. */
    void *words = read_file(arguments[1], &bytes);
    const char *wrong = tsobs_exported_open(&design, words, bytes);
    if (wrong != NULL) {
        quit(arguments[1], wrong);
    }
    const int64_t p = design.sizes.p, m = design.sizes.m;
    double *room = (double *)allocate(design.room * sizeof *room);
    double *row = (double *)allocate(design.row * sizeof *row);
    double *numbers = (double *)allocate((size_t)(1 + p + m + 2 * p) * sizeof *numbers);
    double *y = numbers + 1, *u = y + p, *innovations = u + m, *expected = innovations + p;
    int64_t *codes = (int64_t *)allocate((size_t)(1 + p) * sizeof *codes);
    int64_t stamp, now = 0;
    const measurements sample = {1, &stamp, y, u};
    const outcomes outcome = {codes, codes + 1, innovations, expected};
    tsobs_exported_start(&design, room, &joint);

    FILE *log = fopen(arguments[2], "r");
    if (log == NULL || fgets(line, sizeof line, log) == NULL) {
        quit(arguments[2], "cannot be opened, or is empty");
    }
    print_names(&design.sizes);
    while (fgets(line, sizeof line, log) != NULL) {
        if (line[strspn(line, " \r\n")] == '\0') {
            continue;
        }
        read_numbers(line, numbers, 1 + p + m);
        if (!(0.0 < numbers[0] && numbers[0] < 9e9)) {
            quit(arguments[2], "expected each line to begin with a time above 0");
        }
        stamp = (int64_t)llrint(numbers[0] * 1e9);
        now = stamp > now ? stamp : now;

        /* One step: use the sample, and estimate. */
        tsobs_offer(&joint, &sample, now, &outcome);
        printf("%.17g", numbers[0]);
        if (tsobs_estimate_at(&joint, stamp, row)) {
            for (i = 0; i < design.row; i++) {
                printf(",%.17g", row[i]);
            }
        }
        printf("\n");
    }
    fclose(log);
    free(codes);
    free(numbers);
    free(row);
    free(room);
    free(words);
    return 0;
}
