// Subscribes to a ROS 2 topic with eProsima Fast DDS and prints each message's bytes. Usage: dds DOMAIN TOPIC TYPE COUNT
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <thread>
#include <vector>

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::InstanceHandle_t;
using eprosima::fastrtps::rtps::SerializedPayload_t;

class Raw : public TopicDataType {
 public:
  explicit Raw(const char* name) {
    setName(name);
    m_typeSize = 65536;
    m_isGetKeyDefined = false;
  }
  bool serialize(void*, SerializedPayload_t*) override { return false; }
  bool deserialize(SerializedPayload_t* payload, void* data) override {
    auto& bytes = *static_cast<std::vector<unsigned char>*>(data);
    bytes.assign(payload->data, payload->data + payload->length);
    return true;
  }
  std::function<uint32_t()> getSerializedSizeProvider(void*) override {
    return [] { return 0u; };
  }
  void* createData() override { return new std::vector<unsigned char>; }
  void deleteData(void* data) override { delete static_cast<std::vector<unsigned char>*>(data); }
  bool getKey(void*, InstanceHandle_t*, bool) override { return false; }
};

int main(int, char** arguments) {
  DomainParticipantQos qos;
  auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
  transport->interfaceWhiteList.push_back("127.0.0.1");
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(transport);
  eprosima::fastrtps::rtps::Locator_t peer;
  for (uint32_t id = 0; id < 8; ++id) {  // where the participants of a machine answer; there is no multicast
    eprosima::fastrtps::rtps::IPLocator::setIPv4(peer, 127, 0, 0, 1);
    peer.port = 7400 + 250 * std::atoi(arguments[1]) + 10 + 2 * id;
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  }
  auto* participant = DomainParticipantFactory::get_instance()->create_participant(std::atoi(arguments[1]), qos);
  TypeSupport type(new Raw(arguments[3]));
  type.register_type(participant);
  auto* topic = participant->create_topic(arguments[2], arguments[3], TOPIC_QOS_DEFAULT);
  auto* reader = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT)->create_datareader(topic, DATAREADER_QOS_DEFAULT);
  std::puts("ready");
  std::fflush(stdout);
  std::vector<unsigned char> bytes;
  SampleInfo info;
  for (int left = std::atoi(arguments[4]); left > 0;) {
    if (reader->take_next_sample(&bytes, &info) != ReturnCode_t::RETCODE_OK || !info.valid_data) {
      std::this_thread::sleep_for(std::chrono::milliseconds(10));
      continue;
    }
    for (unsigned char byte : bytes) std::printf("%02x", byte);
    std::puts("");
    std::fflush(stdout);
    --left;
  }
}
