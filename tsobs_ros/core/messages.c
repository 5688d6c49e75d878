/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Messages in the records of an MCAP chunk: a record is a byte for its kind, 8 for the length of
 * what follows, and that. Numbers are little-endian. Where a record begins is known only from those
 * before it, so that no array operation finds them.
 */
#include "messages.h"

#define RECORD_HEAD_SIZE 9
#define MESSAGE_KIND 5

static uint64_t number(const uint8_t *at, int size)
{
    uint64_t value = 0;
    int place;
    for (place = 0; place < size; place++) {
        value |= (uint64_t)at[place] << (8 * place);
    }
    return value;
}

int64_t messages_split(const uint8_t *data, size_t size, int64_t *found, size_t room)
{
    size_t at = 0, count = 0;
    while (at < size) {
        const uint8_t *record = data + at;
        uint64_t length;
        if (size - at < RECORD_HEAD_SIZE || record[0] == 0) {
            return -1;
        }
        length = number(record + 1, 8);
        if (length > size - at - RECORD_HEAD_SIZE) {
            return -1;
        }
        if (record[0] == MESSAGE_KIND) {
            if (length < MESSAGE_HEAD_SIZE - RECORD_HEAD_SIZE || count == room) {
                return -1;
            }
            found[count] = (int64_t)number(record + 9, 2);
            found[room + count] = (int64_t)number(record + 15, 8);
            found[2 * room + count] = (int64_t)number(record + 23, 8);
            found[3 * room + count] = (int64_t)(at + MESSAGE_HEAD_SIZE);
            found[4 * room + count] =
                (int64_t)(length - (MESSAGE_HEAD_SIZE - RECORD_HEAD_SIZE));
            count++;
        }
        at += RECORD_HEAD_SIZE + (size_t)length;
    }
    return (int64_t)count;
}
