/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Exported designs: a head, the model record, and the memory record of a new tracker, as 8-byte
 * words. The size of a tracker's room follows from these.
 */
#include <string.h>

#include "tsobs.h"

/* The text "tsobs-c" as a little-endian number; in another byte order it is another number. */
#define MAGIC UINT64_C(0x00632d73626f7374)
#define HEAD (sizeof(exported_head) / 8)

/* Add bytes to a checksum (FNV-1a of Fowler, Noll and Vo), which begins as EMPTY. */
#define EMPTY UINT64_C(0xcbf29ce484222325)
static uint64_t add_bytes(uint64_t sum, const void *bytes, size_t count)
{
    for (const unsigned char *byte = bytes; count > 0; byte++, count--) {
        sum = (sum ^ *byte) * UINT64_C(0x100000001b3);
    }
    return sum;
}

#define ADD_FIELD(kind, name, rows, columns) #kind " " #name " " #rows " " #columns ","
#define ADD_CONSTANT(name, value, what) #name ","

/* Return a checksum of all fields of an exported design's records: it changes with any of them. */
static uint64_t layout_of_records(void)
{
    static const char *const lists[] = {
        FLOW_FIELDS(ADD_FIELD, s),  SENSOR_FIELDS(ADD_FIELD, s),  HYPOTHESIS_FIELDS(ADD_FIELD, s),
        STATE_FIELDS(ADD_FIELD, s), MODEL_FIELDS(ADD_FIELD, s),   HISTORY_FIELDS(ADD_FIELD, s),
        ESTIMATE_FIELDS(ADD_FIELD, s), BANK_CONSTANTS(ADD_CONSTANT),
    };
    uint64_t sum = EMPTY;
    for (size_t i = 0; i < sizeof lists / sizeof lists[0]; i++) {
        sum = add_bytes(sum, lists[i], strlen(lists[i]));
    }
    return sum;
}

void tsobs_exported_seal(void *words, size_t bytes)
{
    exported_head *head = words;
    head->magic = MAGIC;
    head->layout = layout_of_records();
    head->checksum = add_bytes(EMPTY, head + 1, bytes - sizeof *head);
}

const char *tsobs_exported_open(exported *view, const void *words, size_t bytes)
{
    const exported_head *head = words;
    const size_t least = HEAD + history_size(NULL);
    model m;
    if ((uintptr_t)words % 8 != 0) {
        return "expected words that are aligned to 8 bytes";
    }
    if (bytes < sizeof *head || head->magic != MAGIC) {
        return "no design that `tsobs export-c` wrote, or of another byte order";
    }
    if (head->layout != layout_of_records()) {
        return "exported by another version of tsobs_ros: export it by the one whose sources "
               "this program was built from";
    }
    if (bytes % 8 != 0 || bytes / 8 < least
        || head->checksum != add_bytes(EMPTY, head + 1, bytes - sizeof *head)) {
        return "incomplete or damaged";
    }
    view->model = (const double *)words + HEAD;
    view->model_length = bytes / 8 - least;
    view->memory = view->model + view->model_length;
    const char *wrong = model_view((double *)view->model, view->model_length, &m);
    if (wrong != NULL) {
        return wrong;
    }
    const history start = history_view(NULL, (double *)view->memory);
    if (*start.first != 0 || *start.length != 0 || !tsobs_history_is_sound(&start)) {
        return "its tracker is not new";
    }
    view->sizes = m.s;
    const room_sizes sizes = {&view->sizes, *start.max_steps + SPARE_SLOTS};
    view->room = tracker_room_size(&sizes);
    view->row = estimate_size(&m.s);
    return NULL;
}

void tsobs_exported_start(const exported *from, double *room, tracker *view)
{
    memset(room, 0, from->room * sizeof *room);
    memcpy(room, from->memory, history_size(NULL) * sizeof *room);
    tsobs_tracker_bind(view, (double *)from->model, from->model_length, room, from->room);
}
