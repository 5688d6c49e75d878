/* Copyright 2026 The tsobs_ros contributors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Exported designs: a head, the model record, and the memory record of a new tracker, as 8-byte
 * words. The lengths of a tracker's other memories follow from these.
 */
#include <string.h>

#include "tsobs.h"

#define FORMAT 1
#define MOST_STEPS 1000000000

/* The text "tsobs-c", read as a little-endian number; of another byte order it is another one. */
#define MAGIC INT64_C(0x00632d73626f7374)

/* Add a number to a checksum (Fowler, Noll and Vo's, by words). */
static uint64_t add_word(uint64_t sum, uint64_t word)
{
    sum = (sum ^ word) * UINT64_C(0x100000001b3);
    return sum ^ (sum >> 32);
}

static uint64_t sum_of_words(const int64_t *words, size_t count)
{
    uint64_t sum = UINT64_C(0xcbf29ce484222325);
    size_t i;
    for (i = 0; i < count; i++) {
        sum = add_word(sum, (uint64_t)words[i]);
    }
    return sum;
}

#define ADD_FIELD(kind, name, rows, columns) #kind " " #name " " #rows " " #columns ","
#define ADD_CONSTANT(name, value, what) #name ","

/* Return a number that is another one if any field of the records in an exported design is. */
static int64_t layout_of_records(void)
{
    static const char *const lists[] = {
        FLOW_FIELDS(ADD_FIELD, s),  SENSOR_FIELDS(ADD_FIELD, s),  HYPOTHESIS_FIELDS(ADD_FIELD, s),
        STATE_FIELDS(ADD_FIELD, s), MODEL_FIELDS(ADD_FIELD, s),   HISTORY_FIELDS(ADD_FIELD, s),
        ESTIMATE_FIELDS(ADD_FIELD, s), BANK_CONSTANTS(ADD_CONSTANT),
    };
    uint64_t sum = 0;
    size_t i;
    for (i = 0; i < sizeof lists / sizeof lists[0]; i++) {
        const char *text = lists[i];
        for (; *text != '\0'; text++) {
            sum = add_word(sum, (unsigned char)*text);
        }
    }
    return (int64_t)(sum >> 1);
}

/* Bind a view to the head of some words; return the number of its words. */
static size_t bind_head(exported_head *head, const void *words)
{
    exported_head_bind(head, NULL, (double *)words);
    return exported_head_size(NULL);
}

void exported_seal(void *words, size_t bytes)
{
    exported_head head;
    const size_t begin = bind_head(&head, words), count = bytes / 8;
    *head.magic = MAGIC;
    *head.format = FORMAT;
    *head.layout = layout_of_records();
    *head.words = (int64_t)count;
    *head.checksum = (int64_t)sum_of_words((const int64_t *)words + begin, count - begin);
}

/* Return what is wrong with a head and the words behind it, or NULL. */
static const char *fault_of(const void *words, size_t bytes)
{
    exported_head head;
    const size_t begin = exported_head_size(NULL), count = bytes / 8;
    uint64_t length;
    if ((uintptr_t)words % 8 != 0) {
        return "expected words that are aligned to 8 bytes";
    }
    if (count < begin) {
        return "too short for a design that `tsobs export-c` wrote";
    }
    bind_head(&head, words);
    if (*head.magic != MAGIC) {
        return "no design that `tsobs export-c` wrote, or of another byte order";
    }
    if (*head.format != FORMAT || *head.layout != layout_of_records()) {
        return "exported by another version of tsobs_ros: export it by the one whose sources "
               "this program was built from";
    }
    length = (uint64_t)(count - begin);
    if (*head.words < 0 || (uint64_t)*head.words != count || bytes % 8 != 0) {
        return "incomplete, or longer than it says";
    }
    if ((uint64_t)*head.model_length > length ||
        (uint64_t)*head.memory_length != length - (uint64_t)*head.model_length) {
        return "damaged: its lengths do not add up";
    }
    if ((uint64_t)*head.checksum != sum_of_words((const int64_t *)words + begin, (size_t)length)) {
        return "damaged: its checksum is another one";
    }
    if (head.about[ABOUT - 1] >> 56 != 0) {
        return "damaged: its text does not end";
    }
    return NULL;
}

const char *exported_open(exported *view, const void *words, size_t bytes)
{
    const char *fault = fault_of(words, bytes);
    exported_head head;
    rewind_sizes sizes;
    history start;
    model m;
    if (fault != NULL) {
        return fault;
    }
    view->model = (const double *)words + bind_head(&head, words);
    view->model_length = (size_t)*head.model_length;
    view->memory = view->model + view->model_length;
    view->memory_length = (size_t)*head.memory_length;
    view->about = (const char *)(const void *)head.about;
    if (model_view((double *)view->model, view->model_length, &m) < 0) {
        return "no model record";
    }
    if (view->memory_length != history_size(NULL)) {
        return "no memory record";
    }
    history_bind(&start, NULL, (double *)view->memory);
    if (*start.max_steps < 1 || *start.max_steps > MOST_STEPS || *start.length != 0 ||
        *start.first != 0 || *start.has_base != 0 || *start.span < 0 || *start.future < 0 ||
        *start.restart_after < 0) {
        return "no memory record of a new tracker";
    }
    view->sizes = m.s;
    sizes.s = &view->sizes;
    sizes.slots = *start.max_steps + 2 + SPARE;
    view->ring_length = (size_t)sizes.slots * state_size(&m.s);
    view->scratch_length = rewind_scratch_size(&sizes);
    view->room = view->memory_length + view->ring_length + view->scratch_length;
    view->row = estimate_size(&m.s);
    return NULL;
}

void exported_start(const exported *from, double *room, tracker *view)
{
    const tracker_memory given = {
        (double *)from->model, room, room + from->memory_length,
        room + from->memory_length + from->ring_length,
        from->model_length, from->memory_length, from->ring_length, from->scratch_length,
    };
    memset(room, 0, from->room * sizeof *room);
    memcpy(room, from->memory, from->memory_length * sizeof *room);
    tracker_bind(view, &given);
}
