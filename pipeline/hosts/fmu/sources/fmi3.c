/* The functions of FMI 3.0 for co-simulation around instance.c; those of other interfaces refuse (fmi3_refused.c). */
#include "instance.c"

#include "fmi3Functions.h"

#define STATUS(done) ((done) ? fmi3OK : fmi3Error)

typedef struct {
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
} Listener;

static void tell(const Instance *i, int status, const char *category, const char *words) {
  const Listener *to = i->environment;
  if (to->log) to->log(to->environment, (fmi3Status)status, category, words);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
  (void)visible, (void)event_mode, (void)early_return, (void)intermediate, (void)n_intermediate, (void)update;
  Listener *listener = calloc(1, sizeof *listener);
  if (!listener) return NULL;
  *listener = (Listener){log, environment};
  Instance *made = instance_new(name, token, resources, listener, tell, logging);
  if (!made) free(listener);
  return made;
}

void fmi3FreeInstance(fmi3Instance instance) {
  if (!instance) return;
  free(((Instance *)instance)->environment);
  instance_free(instance);
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[]) {
  bool named = n == 0;
  for (size_t k = 0; k < n; k++) named = named || !strcmp(categories[k], "logStatusWarning");
  ((Instance *)instance)->logs_warnings = on && named;
  return fmi3OK;
}

/* ------------------------------------------------------------------ begin, end */
fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean with_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean with_stop, fmi3Float64 stop) {
  (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
  return STATUS(instance_begin(instance, start));
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) { return STATUS(instance_begun(instance)); }

fmi3Status fmi3Terminate(fmi3Instance instance) {
  instance_end(instance);
  return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
  instance_reset(instance);
  return fmi3OK;
}

/* ------------------------------------------------------------------ variables: scalars, so as many values as references */
static bool as_many(fmi3Instance instance, size_t n, size_t m) {
  return n == m || REFUSE((Instance *)instance, "%zu values for %zu scalar variables", m, n);
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t m) {
  bool done = as_many(instance, n, m);
  for (size_t k = 0; done && k < n; k++) done = get_real(instance, vr[k], &value[k]);
  return STATUS(done);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[],
                          size_t m) {
  bool done = as_many(instance, n, m);
  for (size_t k = 0; done && k < n; k++) done = set_real(instance, vr[k], value[k]);
  return STATUS(done);
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, fmi3Boolean value[], size_t m) {
  bool done = as_many(instance, n, m);
  for (size_t k = 0; done && k < n; k++) done = get_boolean(instance, vr[k], &value[k]);
  return STATUS(done);
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t n, const fmi3Boolean value[],
                          size_t m) {
  bool done = as_many(instance, n, m);
  for (size_t k = 0; done && k < n; k++) done = set_boolean(instance, vr[k], value[k]);
  return STATUS(done);
}

/* ------------------------------------------------------------------ states */
fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state) {
  return STATUS(instance_save(instance, (Saved **)state));
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state) { return STATUS(instance_restore(instance, state)); }

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state) {
  (void)instance;
  if (!state) return fmi3OK;
  free(*state);
  *state = NULL;
  return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size) {
  (void)state;
  *size = saved_size(instance);
  return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
  return STATUS(instance_write(instance, state, bytes, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
  return STATUS(instance_read(instance, bytes, size, (Saved **)state));
}

/* ------------------------------------------------------------------ steps */
fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 from, fmi3Float64 length, fmi3Boolean no_going_back,
                      fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
  (void)no_going_back;
  bool done = instance_step(instance, from, length);
  *event = *terminate = *early = false;
  *reached = ((Instance *)instance)->memory[NOW];
  return STATUS(done);
}

#include "fmi3_refused.c"
