/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Messages in the records of an MCAP chunk.
 */
#ifndef TSOBS_MESSAGES_H
#define TSOBS_MESSAGES_H

#include <stddef.h>
#include <stdint.h>

#define MESSAGE_HEAD_SIZE 31 /* bytes of a message's record before its data */
#define MESSAGE_FIELDS 5

/* Write channel, log time, publish time, first byte and size of the data of each message to
 * `found`, whose rows of `room` numbers take one of these each; there is room for all if it is
 * size / MESSAGE_HEAD_SIZE. Return the number of messages; -1 if a record is not whole, or has no
 * kind. */
int64_t messages_split(const uint8_t *data, size_t size, int64_t *found, size_t room);

#endif
